//! Crops at equal budget: the same window of the same view, by every policy.
//!
//! The window is chosen by a rule and not by hand: of all windows of a quarter of the picture's
//! sides, and at most 160 px, over all views held out, the one whose photograph has the most edges.

use std::path::Path;

use densify_policies::policy::Needs;
use image::{RgbImage, imageops};

use super::{Outcome, at, scenes_and_budgets};
use crate::dataset::images::Image8;
use crate::evaluate::Split;
use crate::failure::Failure;
use crate::number::grouped;
use crate::output::model_path;
use crate::pictures::{photograph, picture, side_by_side, write_png};
use crate::run::finished::{Machine, open_run};
use crate::run::{Observer, Silent};
use crate::study::Picture;
use crate::views::{DatasetViews, ViewSource};

/// Least width of a crop in the picture `[px]`, to which windows are enlarged by whole numbers.
const SHOWN: u32 = 480;
/// Longest side of a window `[px]`: more would be too small to be told apart.
const LONGEST: u32 = 160;
/// Space between crops `[px]`.
const GAP: u32 = 6;

/// A window of a view.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Window {
    x: u32,
    y: u32,
    width: u32,
    height: u32,
}

/// Draws a row of crops for every scene and budget: the photograph, then every policy at the first
/// seed. Runs whose model is gone are left out.
pub(super) fn draw(
    output: &Path,
    outcomes: &[Outcome],
    observer: &dyn Observer,
) -> Result<Vec<Picture>, Failure> {
    let mut pictures = Vec::new();
    for (scene, budget) in scenes_and_budgets(outcomes) {
        let (crops, shown) = crops(output, &at(outcomes, scene, budget), observer)?;
        if crops.is_empty() {
            continue;
        }
        let file = format!("crops-{scene}-{budget}.png");
        write_png(&output.join(&file), &side_by_side(&crops, GAP).into())?;
        let order = shown.join(", ");
        let caption = format!("{scene}, {} rows, from the left: {order}", grouped(budget));
        pictures.push(Picture { file, caption });
    }
    Ok(pictures)
}

/// The crops of the runs at the first seed after that of the photograph, and what each shows.
fn crops(
    output: &Path,
    runs: &[&Outcome],
    observer: &dyn Observer,
) -> Result<(Vec<RgbImage>, Vec<String>), Failure> {
    let (mut crops, mut shown) = (Vec::new(), vec!["photograph".to_owned()]);
    let mut place = None;
    let first = runs.iter().map(|r| r.seed).min();
    for run in runs.iter().filter(|r| Some(r.seed) == first) {
        let folder = output.join("runs").join(&run.run);
        if !model_path(&folder, run.iterations).is_file() {
            observer.say(format_args!("note: {} is gone; no crop of it", folder.display()));
            continue;
        }
        let machine = Machine::default();
        let needs = Needs::default();
        let mut opened = open_run(&folder, run.iterations, None, machine, needs, &Silent)?;
        let views = opened.views(Split::Test)?;
        let background = opened.data.background.fixed();
        let (view, window) = match place {
            Some(place) => place,
            None => {
                let Some((view, window)) = richest_window(&views, background)? else { continue };
                crops.push(cut(&photograph(&*image(&views, view)?, background), window));
                *place.insert((view, window))
            }
        };
        let rendering = opened.backend.render(views.camera(view), background, opened.sh_degree)?;
        crops.push(cut(&picture(&rendering), window));
        shown.push(run.factor.clone());
    }
    Ok((crops, shown))
}

fn image(
    views: &DatasetViews,
    view: usize,
) -> Result<impl std::ops::Deref<Target = Image8>, Failure> {
    views.image(view).map_err(|e| Failure::input(format!("{}: {e}", views.name(view))))
}

/// The window with the most edges of all views.
fn richest_window(
    views: &DatasetViews,
    background: [f32; 3],
) -> Result<Option<(usize, Window)>, Failure> {
    let mut best: Option<(u64, usize, Window)> = None;
    for view in 0..views.count() {
        let (edges, window) = most_edges(&*image(views, view)?, background);
        if best.is_none_or(|(most, ..)| edges > most) {
            best = Some((edges, view, window));
        }
    }
    Ok(best.map(|(_, view, window)| (view, window)))
}

/// The window with the largest sum of |∂G/∂x| + |∂G/∂y| of the green channel, and that sum; of equal
/// ones the first, row by row.
fn most_edges(image: &Image8, background: [f32; 3]) -> (u64, Window) {
    let picture = photograph(image, background);
    let (width, height) = picture.dimensions();
    let side = |of: u32| (of / 4).clamp(1, LONGEST);
    let window = |x, y| Window { x, y, width: side(width), height: side(height) };
    let Window { width: w, height: h, .. } = window(0, 0);
    // Sums over the rectangle from the corner, so that a window's sum takes four of them.
    let columns = width as usize + 1;
    let mut sums = vec![0_u64; columns * (height as usize + 1)];
    let green =
        |x: u32, y: u32| i32::from(picture.get_pixel(x.min(width - 1), y.min(height - 1))[1]);
    for y in 0..height {
        let mut row = 0;
        for x in 0..width {
            let edge =
                (green(x + 1, y) - green(x, y)).abs() + (green(x, y + 1) - green(x, y)).abs();
            row += u64::from(edge.unsigned_abs());
            let at = (y as usize + 1) * columns + x as usize + 1;
            sums[at] = sums[at - columns] + row;
        }
    }
    let sum = |x: u32, y: u32| sums[y as usize * columns + x as usize];
    let mut best = (0, window(0, 0));
    for y in 0..=height - h {
        for x in 0..=width - w {
            let edges = sum(x + w, y + h) + sum(x, y) - sum(x + w, y) - sum(x, y + h);
            if edges > best.0 {
                best = (edges, window(x, y));
            }
        }
    }
    best
}

fn cut(picture: &RgbImage, Window { x, y, width, height }: Window) -> RgbImage {
    let crop = imageops::crop_imm(picture, x, y, width, height).to_image();
    let times = SHOWN.div_ceil(width);
    imageops::resize(&crop, width * times, height * times, imageops::FilterType::Nearest)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_window_with_the_most_edges_is_found() {
        let (width, height) = (40_u32, 24_u32);
        let mut rgb = vec![100_u8; 3 * (width * height) as usize];
        // A checkerboard of 10 × 6 pixels, as large as a window.
        for y in 11..17 {
            for x in 23..33 {
                rgb[3 * (y * width as usize + x) + 1] = if (x + y) % 2 == 0 { 0 } else { 255 };
            }
        }
        let image = Image8 { width, height, rgb, alpha: None, mask: None };
        let (edges, window) = most_edges(&image, [0.0; 3]);
        assert!(edges > 0);
        assert!((22..=23).contains(&window.x) && (10..=11).contains(&window.y), "{window:?}");
        assert_eq!((window.width, window.height), (10, 6));
        let crop = cut(&photograph(&image, [0.0; 3]), window);
        assert_eq!(crop.dimensions(), (480, 288));
        assert_eq!(side_by_side(&[crop.clone(), crop], GAP).dimensions(), (966, 288));
        // Of large photographs too.
        let rgb = vec![0; 3 * 2000 * 700];
        let image = Image8 { width: 2000, height: 700, rgb, alpha: None, mask: None };
        let (_, window) = most_edges(&image, [0.0; 3]);
        assert_eq!((window.width, window.height), (160, 160));
        let crop = cut(&photograph(&image, [0.0; 3]), window);
        assert_eq!(crop.dimensions(), (480, 480));
    }
}
