//! Compares crops of renders: the same window of the same view for every policy under the same limit.
//!
//! The window is chosen by a fixed rule: of all windows of all test photographs, the one with the most edges.

use std::path::Path;

use densify_policies::policy::Needs;
use image::{RgbImage, imageops};

use super::{Outcome, outcomes_at, scenes_and_limits};
use crate::Picture;
use crate::window::Window;
use densify_core::image::SharedImage;
use densify_data::views::{DatasetViews, ViewSource};
use densify_run::failure::Failure;
use densify_run::finished::{Machine, open_run};
use densify_run::{Observer, Silent};
use densify_train::evaluate::Split;
use densify_train::output::model_path;
use densify_train::pictures::{photograph, picture, side_by_side, write_png};

/// Minimum width of an enlarged crop `[px]`. The enlargement factor is an integer.
const MIN_WIDTH: u32 = 480;
/// Space between crops `[px]`.
const GAP: u32 = 6;

/// Draws a row of crops for each scene and limit: the photograph, then each policy at the first seed. Runs whose model
/// file no longer exists are left out.
pub(super) fn draw(
    output: &Path,
    outcomes: &[Outcome],
    observer: &dyn Observer,
) -> Result<Vec<Picture>, Failure> {
    let mut pictures = Vec::new();
    for (scene, limit) in scenes_and_limits(outcomes) {
        let (crops, names) = crops(output, &outcomes_at(outcomes, scene, limit), observer)?;
        if crops.is_empty() {
            continue;
        }
        let file = format!("crops-{scene}-{}.png", limit.word());
        write_png(&output.join(&file), &side_by_side(&crops, GAP).into())?;
        let order = names.join(", ");
        let caption = format!("{scene}, {limit}, from the left: {order}");
        pictures.push(Picture { file, caption });
    }
    Ok(pictures)
}

/// The crops of the photograph and of the runs at the first seed, with their names.
fn crops(
    output: &Path,
    runs: &[&Outcome],
    observer: &dyn Observer,
) -> Result<(Vec<RgbImage>, Vec<String>), Failure> {
    let (mut crops, mut names) = (Vec::new(), vec!["photograph".to_owned()]);
    let mut chosen = None;
    let first_seed = runs.iter().map(|r| r.seed).min();
    for run in runs.iter().filter(|r| Some(r.seed) == first_seed) {
        let folder = output.join("runs").join(&run.run);
        if !model_path(&folder, run.iterations).is_file() {
            observer.say(format_args!(
                "note: {} no longer exists; its crop is left out",
                folder.display()
            ));
            continue;
        }
        let machine = Machine::default();
        let needs = Needs::default();
        let mut opened = open_run(&folder, run.iterations, None, (None, machine), needs, &Silent)?;
        let views = opened.views(Split::Test)?;
        let background = opened.data.background.fixed();
        let (view, window) = match chosen {
            Some(chosen) => chosen,
            None => {
                let Some((view, window)) = choose_window(&views, background)? else { continue };
                crops.push(enlarge(&photograph(&*image(&views, view)?, background), window));
                *chosen.insert((view, window))
            }
        };
        let rendering = opened.backend.render(views.camera(view), background, opened.sh_degree)?;
        crops.push(enlarge(&picture(&rendering), window));
        names.push(run.factor.clone());
    }
    Ok((crops, names))
}

fn image(views: &DatasetViews, view: usize) -> Result<SharedImage, Failure> {
    views.image(view).map_err(|e| Failure::input(format!("{}: {e}", views.name(view))))
}

/// Finds the view and the window with the most edges.
fn choose_window(
    views: &DatasetViews,
    background: [f32; 3],
) -> Result<Option<(usize, Window)>, Failure> {
    let mut best: Option<(u64, usize, Window)> = None;
    for view in 0..views.count() {
        let (edges, window) =
            Window::with_most_edges(&photograph(&*image(views, view)?, background));
        if best.is_none_or(|(most, ..)| edges > most) {
            best = Some((edges, view, window));
        }
    }
    Ok(best.map(|(_, view, window)| (view, window)))
}

/// Crops a picture and enlarges the crop by an integer factor.
fn enlarge(picture: &RgbImage, window: Window) -> RgbImage {
    let crop = window.crop(picture);
    let (width, height) = crop.dimensions();
    let factor = MIN_WIDTH.div_ceil(width);
    imageops::resize(&crop, width * factor, height * factor, imageops::FilterType::Nearest)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn crops_are_enlarged_by_whole_numbers() {
        for ((width, height), enlarged) in [((40, 24), (480, 288)), ((2000, 700), (480, 480))] {
            let picture = RgbImage::new(width, height);
            let (_, window) = Window::with_most_edges(&picture);
            let crop = enlarge(&picture, window);
            assert_eq!(crop.dimensions(), enlarged);
            let pair = side_by_side(&[crop.clone(), crop], GAP);
            assert_eq!(pair.dimensions(), (2 * enlarged.0 + GAP, enlarged.1));
        }
    }
}
