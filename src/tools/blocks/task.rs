//! Runs a task. A task that was killed resumes from its last checkpoint, and gives the same result, byte for byte.

use std::fs;
use std::path::Path;

use glam::DVec3;

use super::status::is_complete;
use super::{
    BLOCK_FILE, BlockPlan, COARSE_FILE, MERGED_FILE, Task, block_folder, merge, run_folder,
};
use densify_core::camera::Camera;
use densify_core::files::{FileError, write_atomically};
use densify_core::numbers::gaussians;
use densify_data::dataset::{Dataset, TrackReading};
use densify_data::models::PLY;
use densify_launch::utf8;
use densify_run::failure::Failure;
use densify_run::finished::{iteration, read_model};
use densify_run::{Host, Observer, Occupied, Partial, Run, start};
use densify_train::output::model_path;

/// File that lists the views of a block.
pub(super) const VIEWS_FILE: &str = "views.txt";
/// Files with the coarse Gaussians from which a block starts, and with those that it renders as frozen.
const START_FILE: &str = "start.ply";
const FROZEN_FILE: &str = "frozen.ply";
/// Distance beyond an image's border at which a Gaussian may still contribute to it, as a fraction of the image's size.
const IMAGE_MARGIN: f64 = 0.25;

/// Runs or resumes a task of the plan in a folder.
///
/// # Errors
/// If a task that it depends on is incomplete, a file of the plan is missing, or the run fails.
pub fn run(
    folder: &Path,
    plan: &BlockPlan,
    task: Task,
    threads: Option<u32>,
    observer: &dyn Observer,
) -> Result<(), Failure> {
    // A complete merge is repeated, because blocks may have changed since.
    if task != Task::Merge && is_complete(folder, plan, task) {
        observer.say(format_args!("{} is complete", plan.name(task)));
        return Ok(());
    }
    let given = match task {
        Task::Coarse => budget(plan.coarse.rows).over(read_options(&folder.join(COARSE_FILE))?),
        Task::Block(index) => prepare_block(folder, plan, index, observer)?,
        Task::Merge => {
            let output = folder.join(MERGED_FILE);
            let merged = merge(folder, plan, &output, PLY, false, observer)?;
            observer.say(format_args!("{}: {}", output.display(), gaussians(merged.rows)));
            return Ok(());
        }
    };
    let output = run_folder(folder, plan, task);
    let scene = Partial::option("scene", utf8(&plan.scene)?);
    let mut options = path_option("output", &output)?.over(scene).over(given);
    if let Some(threads) = threads {
        options = Partial::option("threads", i64::from(threads)).over(options);
    }
    let (spec, resumed) = start(options, observer)?;
    Run::prepare_on(&spec, resumed, Host::new(observer))?.train(Occupied::Resume, observer)?;
    Ok(())
}

/// An option whose value is an absolute path.
fn path_option(name: &str, path: &Path) -> Result<Partial, Failure> {
    let path = std::path::absolute(path).map_err(Failure::input)?;
    Ok(Partial::option(name, utf8(&path)?))
}

fn budget(rows: usize) -> Partial {
    Partial::option("budget", i64::try_from(rows).unwrap_or(i64::MAX))
}

fn read_options(path: &Path) -> Result<Partial, Failure> {
    Partial::read(path).map_err(|failure| {
        failure.and("this file is a part of the plan; if it is lost, plan again in another folder")
    })
}

/// Splits the coarse model into the Gaussians that a block trains and those that it renders as frozen, writes both, and
/// returns the options of the block's run.
fn prepare_block(
    folder: &Path,
    plan: &BlockPlan,
    index: usize,
    observer: &dyn Observer,
) -> Result<Partial, Failure> {
    let block = &plan.block[index];
    let block_folder = block_folder(folder, &block.name);
    let given = read_options(&block_folder.join(BLOCK_FILE))?;
    let views = path_option("views", &block_folder.join(VIEWS_FILE))?;
    if !is_complete(folder, plan, Task::Coarse) {
        return Err(Failure::input(format!(
            "{} starts from the coarse model, which is not complete; run the task coarse first",
            block.name
        )));
    }
    let run = run_folder(folder, plan, Task::Coarse);
    let model = read_model(&model_path(&run, iteration(&run, None)?), observer)?;
    let cell = block.cell.widened(plan.margin);
    let trained = plan.rows_in_cell(&cell, &model);
    if trained.is_empty() {
        return Err(Failure::input(format!(
            "{}: the coarse model has no Gaussian in its cell; plan with fewer --blocks or more --coarse-rows",
            block.name
        )));
    }
    let cameras = world_cameras(plan, views.clone().over(given.clone()))?;
    let is_frozen = |row: &usize| {
        let centre = DVec3::from(model.position(*row));
        let is_visible = |camera: &Camera| camera.depth_in_image(centre, IMAGE_MARGIN).is_some();
        !plan.is_in_cell(&cell, centre) && cameras.iter().any(is_visible)
    };
    let frozen: Vec<usize> = (0..model.len()).filter(is_frozen).collect();
    let write = |option: &str, file: &str, rows: &[usize]| {
        let path = block_folder.join(file);
        write_atomically(&path, |out| PLY.write(&model.gather(rows), out))?;
        path_option(option, &path)
    };
    let mut options = write("init", START_FILE, &trained)?;
    if frozen.is_empty() {
        let path = block_folder.join(FROZEN_FILE);
        match fs::remove_file(&path) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                return Err(FileError::io("remove", &path)(error).into());
            }
            _ => {}
        }
    } else {
        options = write("freeze", FROZEN_FILE, &frozen)?.over(options);
    }
    let options = views.over(options).over(budget(block.budget + frozen.len())).over(given);
    // The coarse model is only a starting point, not a trained model to preserve.
    Ok(options.over(Partial::option("init_rates", "full")))
}

/// The cameras of a block's training views, in world coordinates.
fn world_cameras(plan: &BlockPlan, options: Partial) -> Result<Vec<Camera>, Failure> {
    let spec = options.describe()?;
    let dataset = Dataset::load(&plan.scene, &spec.data.load_options(TrackReading::Nothing))?;
    let to_world = &dataset.normalisation;
    Ok(dataset.train.iter().map(|view| to_world.world_from_scene_camera(&view.camera)).collect())
}
