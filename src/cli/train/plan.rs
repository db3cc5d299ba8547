//! `densify plan`: what a run would take, without the run.

use super::TrainArgs;
use super::demand::Survey;
use super::size::{self, RESOLUTIONS, Size};
use crate::cli::console::Console;
use crate::cli::failure::Failure;
use crate::cli::number::grouped;
use crate::cli::scene::largest_image;
use crate::memory::Bytes;

/// Prints the ledger of a run, and what else its memory could hold. Writes nothing.
pub(in crate::cli) fn run(args: &TrainArgs, console: &Console) -> Result<(), Failure> {
    if args.resume {
        return Err(Failure::input(
            "--resume: a run that goes on has the size that it began with (config.toml); leave it out \
             to plan a new one",
        ));
    }
    let survey = Survey::of(args, None, console)?;
    if let Some(line) = survey.degree.line() {
        console.result(line);
    }
    let size = Size::choose(args, &survey)?;
    for line in size.lines(args, &survey) {
        console.result(line);
    }
    let needs = survey.needs(args, size.setting.rows)?;
    let ledger = survey.ledger(args, &size.setting, &needs, size::threads(args));
    size::check(args, &survey, &ledger)?;
    console.result(format_args!("memory promised\n{ledger}"));
    let memory = args.memory.unwrap_or_else(|| survey.bounded(&ledger));
    console.result(alternatives(args, survey, memory)?);
    Ok(())
}

/// Rows by degree and resolution.
fn alternatives(args: &TrainArgs, survey: Survey, memory: u64) -> Result<String, Failure> {
    let own = survey.scene.resolution.unwrap_or(1);
    let mut surveys: Vec<(u32, Survey)> = RESOLUTIONS
        .iter()
        .filter(|&&divisor| divisor != own)
        .filter_map(|&divisor| Some((divisor, survey.at_resolution(args, divisor)?)))
        .collect();
    surveys.push((own, survey));
    // A number above 8 is a width.
    surveys.sort_by_key(|(resolution, _)| if *resolution > 8 { 0 } else { *resolution });
    let mut text = format!("rows that --memory {} holds\n  {:<11}", Bytes(memory), "");
    for (resolution, survey) in &surveys {
        let (width, height) = largest_image(&survey.dataset);
        text += &format!("{:>22}", format!("-r {resolution} ({width}x{height})"));
    }
    for degree in 0..=3 {
        text += &format!("\n  degree {degree:<4}");
        for (_, survey) in &surveys {
            let rows = size::rows_at(args, survey, memory, degree)?;
            text += &format!("{:>22}", rows.map_or_else(|| "none".to_owned(), grouped));
        }
    }
    Ok(text)
}
