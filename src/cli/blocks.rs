//! `densify blocks`: trains a large scene as blocks, each a run of its own.

use std::fmt::Write as _;
use std::path::PathBuf;

use clap::{Args, Subcommand};

use super::console::Console;
use super::export::{check_output, format_from_extension};
use super::flags::parse_words;
use super::threads;
use super::train::Follower;
use densify_blocks as blocks;
use densify_blocks::{
    Block, BlockPlan, Grid, PlanOptions, Size, Task, TaskState, merge, plan, status, submit,
};
use densify_core::memory::Bytes;
use densify_core::numbers::{gaussians, grouped};
use densify_launch::{Engine, SubmissionArgs};
use densify_run::failure::Failure;
use densify_run::{ByteCount, Fraction, Rows, Threads, Whole};

/// Trains a large scene in blocks, on one machine or on a cluster, and merges them.
///
/// The ground is divided into cells of equal work. A coarse run sees the whole scene; each block then starts from its
/// part of the coarse model, with everything else in its views frozen, and trains its share of the Gaussians. The
/// merged model never exceeds the requested size, and the memory of every task is known before it starts.
#[derive(Debug, Args)]
pub(super) struct BlocksArgs {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Plan(PlanArgs),
    Submit(SubmitArgs),
    Run(RunArgs),
    Status(StatusArgs),
    Merge(MergeArgs),
}

/// Divides a scene into blocks, and writes a folder with everything that the tasks need.
///
/// Prints the size and memory of each task; DIR/plan.svg shows the blocks from above.
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
struct PlanArgs {
    /// Folder or ZIP archive of the dataset, or scene:NAME for a built-in scene
    #[arg(value_name = "SCENE")]
    scene: PathBuf,
    /// Folder to write the plan to
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Maximum number of Gaussians in the merged model, such as 2M or 500k
    #[arg(long, value_name = "N", required_unless_present = "bytes", conflicts_with = "bytes")]
    rows: Option<Rows>,
    /// Maximum size of the merged model as a PLY file, such as 500MB
    #[arg(long, value_name = "SIZE")]
    bytes: Option<ByteCount>,
    /// Number of blocks: strips along the longer side of the ground (4), or strips times blocks per strip (3x2); auto:
    /// the fewest whose tasks fit into --memory
    #[arg(long, value_name = "auto|K|KxL", default_value = "auto")]
    blocks: Grid,
    /// Maximum memory of a task, such as 8GiB
    #[arg(long, value_name = "SIZE", required_if_eq("blocks", "auto"))]
    memory: Option<ByteCount>,
    /// Budget of the coarse run `[default: two fifths of the merged model, at most half of what fits --memory, at
    /// least 1,000]`
    #[arg(long, value_name = "N")]
    coarse_rows: Option<Rows>,
    /// Width of the margin around a cell in which its block also trains, as a share of the usual width of a cell
    #[arg(long, value_name = "FRACTION", default_value = "0.1")]
    margin: Fraction,
    /// Options of `densify train` for every run, after `--`; --iterations is the length of one run over the whole
    /// scene: each block trains for a part of it, in proportion to the block's share of the views
    #[arg(last = true, value_name = "TRAIN OPTIONS")]
    train: Vec<String>,
}

const EXAMPLES: &str = "\
Examples:
  densify blocks plan data/city -o city --rows 2M --memory 8GiB -- -r 2 --eval
  densify blocks plan data/city -o city --bytes 500MB --blocks 3x2 -- --policy diet --threads 8
  densify blocks submit city --engine slurm
  densify blocks status city";

/// Starts the incomplete tasks of a plan, on this machine or on a cluster whose machines share the folder.
#[derive(Debug, Args)]
struct SubmitArgs {
    /// Folder of the plan
    #[arg(value_name = "DIR")]
    folder: PathBuf,
    /// Engine that starts the tasks
    #[arg(long, value_name = "ENGINE", default_value = "local")]
    engine: Engine,
    #[command(flatten)]
    options: SubmissionArgs,
}

/// Runs one task of a plan, or resumes it. Schedulers call this command.
#[derive(Debug, Args)]
struct RunArgs {
    /// Folder of the plan
    #[arg(value_name = "DIR")]
    folder: PathBuf,
    /// coarse, the name of a block, or merge
    #[arg(value_name = "TASK")]
    task: String,
    /// Processor threads, in place of the number in the plan; the result does not depend on it
    #[arg(long, value_name = "N")]
    threads: Option<Threads>,
}

/// Prints the progress of each task, as recorded in the folder.
#[derive(Debug, Args)]
struct StatusArgs {
    /// Folder of the plan
    #[arg(value_name = "DIR")]
    folder: PathBuf,
}

/// Merges the blocks into one model, which takes from each block the Gaussians in the block's cell.
#[derive(Debug, Args)]
struct MergeArgs {
    /// Folder of the plan
    #[arg(value_name = "DIR")]
    folder: PathBuf,
    /// File to write; its extension selects the format, as for `densify export`
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Merge only the complete blocks, and list the others
    #[arg(long)]
    partial: bool,
    /// Replace a file that exists
    #[arg(long)]
    overwrite: bool,
}

pub(super) fn run(args: &BlocksArgs, console: &Console) -> Result<(), Failure> {
    match &args.command {
        Command::Plan(args) => run_plan(args, console),
        Command::Submit(args) => run_submit(args, console),
        Command::Run(args) => run_task(args, console),
        Command::Status(args) => run_status(args, console),
        Command::Merge(args) => run_merge(args, console),
    }
}

fn run_plan(args: &PlanArgs, console: &Console) -> Result<(), Failure> {
    let size = match (args.rows, args.bytes) {
        (Some(rows), _) => Size::Rows(rows.0),
        (None, Some(bytes)) => Size::Bytes(bytes.0),
        (None, None) => return Err(Failure::input("give --rows or --bytes")),
    };
    let options = PlanOptions {
        scene: args.scene.clone(),
        output: args.output.clone(),
        size,
        memory: args.memory.map(|bytes| bytes.0),
        grid: args.blocks,
        coarse_rows: args.coarse_rows.map(|rows| rows.0),
        margin: args.margin.0,
        given: parse_words(&args.train, "densify blocks plan ... --")?,
    };
    threads::limit(options.given.clone().describe().ok().and_then(|spec| spec.device.threads));
    let blocks = plan(&options, console)?;
    console.result(format_table(&blocks));
    console.result(format_args!("the plan is in {}", args.output.display()));
    Ok(())
}

/// One line per task: its size, its share of the work, and its memory.
fn format_table(blocks: &BlockPlan) -> String {
    let mut text = String::new();
    let mut row = |cells: [String; 7]| {
        let [task, rows, trained, views, iterations, work, memory] = cells;
        let line_break = if text.is_empty() { "" } else { "\n" };
        let _ = write!(
            text,
            "{line_break}{task:<14} {rows:>11} {trained:>11} {views:>7} {iterations:>11} {work:>7} {memory:>11}"
        );
    };
    let head = ["task", "Gaussians", "in training", "views", "iterations", "work", "memory"];
    row(head.map(str::to_owned));
    for task in blocks.tasks() {
        let (rows, trained, views, work) = match task {
            Task::Coarse => {
                let rows = blocks.coarse.rows;
                (rows, grouped(rows), "all".to_owned(), String::new())
            }
            Task::Block(index) => {
                let Block { rows, budget, views, work, .. } = &blocks.block[index];
                (*rows, grouped(*budget), grouped(*views), format!("{:.1} %", 100.0 * work))
            }
            Task::Merge => (blocks.rows, String::new(), String::new(), String::new()),
        };
        let iterations = match blocks.iterations(task) {
            0 => String::new(),
            iterations => grouped(iterations as usize),
        };
        let memory = Bytes(blocks.memory(task)).to_string();
        row([
            blocks.name(task).to_owned(),
            grouped(rows),
            trained,
            views,
            iterations,
            work,
            memory,
        ]);
    }
    text
}

fn run_submit(args: &SubmitArgs, console: &Console) -> Result<(), Failure> {
    let submission = args.options.for_engine(args.engine)?;
    let blocks = BlockPlan::read(&args.folder)?;
    let follower = Follower::new(console);
    follower.listen();
    submit(&args.folder, &blocks, submission, &follower)
}

fn run_task(args: &RunArgs, console: &Console) -> Result<(), Failure> {
    let blocks = BlockPlan::read(&args.folder)?;
    let task = blocks.task(&args.task)?;
    let follower = Follower::new(console);
    follower.listen();
    threads::limit(Some(args.threads.unwrap_or(Whole(blocks.threads))));
    blocks::run(&args.folder, &blocks, task, args.threads.map(|threads| threads.0), &follower)
}

fn run_status(args: &StatusArgs, console: &Console) -> Result<(), Failure> {
    let blocks = BlockPlan::read(&args.folder)?;
    let (mut complete, mut left) = (0, 0);
    for (task, state) in status(&args.folder, &blocks) {
        *(if state == TaskState::Complete { &mut complete } else { &mut left }) += 1;
        let last = blocks.iterations(task);
        let state = match state {
            TaskState::Waiting => "waiting".to_owned(),
            TaskState::Running(step) => format!("running, saved {step} of {last} steps"),
            TaskState::Stopped(step) => format!("stopped, saved {step} of {last} steps"),
            TaskState::Complete => "complete".to_owned(),
        };
        console.result(format_args!("{:<14} {state}", blocks.name(task)));
    }
    console.result(format_args!("{complete} complete, {left} to go"));
    Ok(())
}

fn run_merge(args: &MergeArgs, console: &Console) -> Result<(), Failure> {
    let format = format_from_extension(&args.output)?;
    check_output(&args.output, args.overwrite)?;
    let blocks = BlockPlan::read(&args.folder)?;
    let merged = merge(&args.folder, &blocks, &args.output, format, args.partial, console)?;
    if !merged.missing.is_empty() {
        console
            .say(format_args!("note: incomplete blocks left out: {}", merged.missing.join(", ")));
    }
    console.result(format_args!(
        "{} ({}): {}, {}",
        args.output.display(),
        format.name,
        gaussians(merged.rows),
        Bytes(merged.bytes)
    ));
    Ok(())
}
