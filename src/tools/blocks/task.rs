//! Runs one task. Killed and started again, it goes on from its last checkpoint to the same bytes.

use std::fs;
use std::path::Path;

use super::crop::{beyond, inside};
use super::{BLOCK_FILE, Blocks, COARSE_FILE, MERGED_FILE, Task, block_folder, merge, run_folder};
use densify_core::camera::Camera;
use densify_core::files::{FileError, write_atomically};
use densify_core::gaussians::Gaussians;
use densify_core::numbers::grouped;
use densify_data::dataset::Dataset;
use densify_data::models::PLY;
use densify_launch::utf8;
use densify_run::failure::Failure;
use densify_run::finished::{iteration, read_model};
use densify_run::{Host, Observer, Occupied, Partial, Run, start};
use densify_train::output::model_path;

/// Names of a block's views.
pub(super) const VIEWS_FILE: &str = "views.txt";
/// What of the coarse model a block starts from, and what it has frozen.
const START_FILE: &str = "start.ply";
const FROZEN_FILE: &str = "frozen.ply";

/// Runs a task of the plan in a folder, or what is left of it.
///
/// # Errors
/// When a task that it needs is not complete, a file of the plan is missing, and as a run's.
pub fn run(
    folder: &Path,
    blocks: &Blocks,
    task: Task,
    threads: Option<u32>,
    observer: &dyn Observer,
) -> Result<(), Failure> {
    // A merge is made again, as what it is made of may have changed.
    if task != Task::Merge && super::status::is_complete(folder, blocks, task) {
        observer.say(format_args!("{} is complete", blocks.name(task)));
        return Ok(());
    }
    let given = match task {
        Task::Coarse => coarse(folder, blocks)?,
        Task::Block(place) => block(folder, blocks, place, observer)?,
        Task::Merge => {
            let output = folder.join(MERGED_FILE);
            let merged = merge(folder, blocks, &output, PLY, false, observer)?;
            observer.say(format_args!("{}: {} Gaussians", output.display(), grouped(merged.rows)));
            return Ok(());
        }
    };
    let output = run_folder(folder, blocks, task);
    let scene = Partial::option("scene", utf8(&blocks.scene)?);
    let own = text("output", &output)?.over(scene);
    let own = match threads {
        Some(threads) => Partial::option("threads", i64::from(threads)).over(own),
        None => own,
    };
    let (spec, resumed) = start(own.over(given), observer)?;
    let run = Run::prepare_on(&spec, resumed, Host::new(observer))?;
    run.train(Occupied::Resume, observer)?;
    Ok(())
}

/// An option that is the path of a file in the plan's folder.
fn text(name: &str, path: &Path) -> Result<Partial, Failure> {
    let path = std::path::absolute(path).map_err(Failure::input)?;
    Ok(Partial::option(name, utf8(&path)?))
}

fn rows(budget: usize) -> Partial {
    Partial::option("budget", i64::try_from(budget).unwrap_or(i64::MAX))
}

fn described(path: &Path) -> Result<Partial, Failure> {
    Partial::read(path).map_err(|failure| {
        failure.and("this file is a part of the plan; if it is lost, plan again in another folder")
    })
}

fn coarse(folder: &Path, blocks: &Blocks) -> Result<Partial, Failure> {
    Ok(rows(blocks.coarse.rows).over(described(&folder.join(COARSE_FILE))?))
}

/// Cuts the coarse model in two, and describes the run of a block between them.
fn block(
    folder: &Path,
    blocks: &Blocks,
    place: usize,
    observer: &dyn Observer,
) -> Result<Partial, Failure> {
    let block = &blocks.block[place];
    let own = block_folder(folder, &block.name);
    let given = described(&own.join(BLOCK_FILE))?;
    let views = own.join(VIEWS_FILE);
    if !super::status::is_complete(folder, blocks, Task::Coarse) {
        return Err(Failure::input(format!(
            "{} starts from the coarse model, which is not complete; run the task coarse first",
            block.name
        )));
    }
    let run = run_folder(folder, blocks, Task::Coarse);
    let model = read_model(&model_path(&run, iteration(&run, None)?), observer)?;
    let cell = block.cell.widened(blocks.margin);
    let first = inside(blocks, &cell, &model, 0);
    if first.is_empty() {
        return Err(Failure::input(format!(
            "{}: the coarse model has no Gaussian there; plan with fewer --blocks or more --coarse-rows",
            block.name
        )));
    }
    let cameras = cameras(blocks, given.clone(), &views)?;
    let frozen = beyond(blocks, &cell, &model, &cameras);
    let put = |file: &str, model: Gaussians| -> Result<Partial, Failure> {
        let path = own.join(file);
        write_atomically(&path, |out| PLY.write(&model, out))?;
        text(if file == START_FILE { "init" } else { "freeze" }, &path)
    };
    let mut all = put(START_FILE, model.gather(&first))?;
    if frozen.is_empty() {
        let path = own.join(FROZEN_FILE);
        match fs::remove_file(&path) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                return Err(FileError::io("remove", &path)(error).into());
            }
            _ => {}
        }
    } else {
        all = put(FROZEN_FILE, model.gather(&frozen))?.over(all);
    }
    let all = text("views", &views)?.over(all).over(rows(block.budget + frozen.len()));
    // The coarse model is where a block begins, not what it is to keep.
    Ok(all.over(given).over(Partial::option("init_rates", "full")))
}

/// The cameras of a block's training views, in world coordinates.
fn cameras(blocks: &Blocks, given: Partial, views: &Path) -> Result<Vec<Camera>, Failure> {
    let spec = text("views", views)?.over(given).describe()?;
    let dataset = Dataset::load(&blocks.scene, &spec.data.load_options(false))?;
    let to_world = &dataset.normalisation;
    Ok(dataset.train.iter().map(|view| to_world.world_from_scene_camera(&view.camera)).collect())
}
