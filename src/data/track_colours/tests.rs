//! Tests of track colours in synthetic views.

use std::path::Path;

use glam::{DMat3, DVec3};

use super::exposures::ExposureSpread;
use super::*;
use crate::dataset::builtin::PREFIX;
use crate::dataset::images::ImageSource;
use crate::dataset::{Dataset, LoadOptions, TrackReading, View};
use crate::error::LoadError;
use densify_core::camera::Camera;
use densify_core::image::Image8;
use densify_core::vignette::{PhotographPlace, Vignette};

const SIZE: u32 = 60;
const VIEWS: usize = 8;

fn measured(tracks: &Tracks, views: &[View]) -> Result<Spread, LoadError> {
    Ok(measure(tracks, &TrackColours::read(tracks, views)?))
}

/// Views of a wall of 20 x 20 coloured squares, each 3 px wide, from one place; `shade` changes the colour of a square
/// in a view.
fn scene(shade: impl Fn(usize, usize, f32) -> f32) -> (Tracks, Vec<View>) {
    let squares = (SIZE / 3) as usize;
    let colour =
        |square: usize| [square * 37, square * 59, square * 83].map(|v| (40 + v % 120) as f32);
    let mut tracks = Tracks::default();
    // The first and the last row of squares are left out.
    for square in (0..squares * squares).filter(|s| s / squares > 0 && s / squares < squares - 1) {
        let (x, y) = (3 * (square % squares) + 1, 3 * (square / squares) + 1);
        tracks.positions.push(DVec3::new(x as f64 + 0.5, y as f64 + 0.5, 1.0));
        tracks.colours.push(colour(square).map(|v| v as u8));
        tracks.views.push((0..VIEWS as u32).collect());
    }
    let views = (0..VIEWS).map(|view| {
        let pixels = (0..SIZE * SIZE).map(|p| (p % SIZE / 3 + p / SIZE / 3 * (SIZE / 3)) as usize);
        let rgb = pixels.flat_map(|s| colour(s).map(|v| shade(view, s, v).clamp(0.0, 255.0) as u8));
        posed(Image8 { width: SIZE, height: SIZE, rgb: rgb.collect(), alpha: None, mask: None })
    });
    (tracks, views.collect())
}

fn posed(image: Image8) -> View {
    let (width, height) = (image.width, image.height);
    let camera = Camera::centred((width, height), (1.0, 1.0), DMat3::IDENTITY, DVec3::ZERO);
    let camera = Camera { cx: 0.0, cy: 0.0, ..camera };
    View {
        name: "made".into(),
        camera,
        source: ImageSource::rendered("made".into(), image, (width, height)),
    }
}

#[test]
fn constant_colours_need_degree_0_whatever_the_exposure() {
    for exposures in [[1.0; VIEWS], [1.0, 0.8, 1.1, 0.7, 1.0, 1.2, 0.9, 1.05]] {
        let (tracks, views) = scene(|view, _, value| value * exposures[view]);
        let found = measured(&tracks, &views).unwrap();
        assert_eq!(found.tracks, tracks.count());
        assert!(found.twentieth < 0.75, "rounding to whole steps: {found:?}");
    }
}

/// Gains of the views lead to learned exposures; colours that change per view without a common factor do not.
#[test]
fn exposures_are_found_where_gains_explain_the_colours() {
    let exposures = [1.0, 0.8, 1.1, 0.7, 1.0, 1.2, 0.9, 1.05];
    let found = |shade: &dyn Fn(usize, usize, f32) -> f32| {
        let (tracks, views) = scene(shade);
        let (found, gains) = ExposureSpread::measure(&TrackColours::read(&tracks, &views).unwrap());
        assert_eq!((found.tracks, found.views), (tracks.count(), VIEWS));
        // As if there were enough tracks for a decision.
        (ExposureSpread { tracks: MIN_TRACKS, ..found }, gains)
    };
    let (differ, gains) = found(&|view, _, value| value * exposures[view]);
    assert_eq!(differ.decision(VIEWS), Some(true), "{differ:?}");
    assert!((differ.stops - 0.6).abs() < 0.05 && differ.with_gains < 1.0, "{differ:?}");
    let mean = exposures.iter().map(|e: &f32| e.ln()).sum::<f32>() / VIEWS as f32;
    for (gains, exposure) in gains.iter().zip(exposures) {
        assert!(gains.iter().all(|gain| (gain - exposure / mean.exp()).abs() < 0.01), "{gains:?}");
    }
    // Half of the colours are clipped in the brightest view and cannot be used to fit its gain.
    let (_, gains) = found(&|view, _, value| 2.2 * value * exposures[view]);
    let brightest = exposures[5] / mean.exp();
    assert!(gains[5].iter().all(|gain| (gain - brightest).abs() < 0.01), "{gains:?}");
    let (alike, gains) = found(&|_, _, value| value);
    assert_eq!(alike.decision(VIEWS), Some(false), "{alike:?}");
    assert!(gains.iter().flatten().all(|gain| (gain - 1.0).abs() < 1e-6), "{gains:?}");
    // Each square has a factor of its own in each view.
    let (noise, _) = found(&|view, square, value| {
        value * (0.6 + 0.1 * ((view * 31 + square * 17 + view * square * 7) % 9) as f32)
    });
    assert_eq!(noise.decision(VIEWS), Some(false), "{noise:?}");
    assert_eq!(differ.decision(2 * VIEWS), None, "half of the views are unknown");
}

#[test]
fn colours_that_change_with_the_view_need_a_higher_degree() {
    for (strength, degree) in [(0.0, 0), (2.0, 1), (5.0, 2), (30.0, 3)] {
        // A tenth of the squares shine in half of the views.
        let shade = |view: usize, square: usize, value: f32| match square % 10 {
            0 if view.is_multiple_of(2) => value + strength,
            _ => value,
        };
        let (tracks, views) = scene(shade);
        let found = Spread { tracks: MIN_TRACKS, ..measured(&tracks, &views).unwrap() };
        assert_eq!(found.degree(), Some(degree), "{strength}: {found:?}");
    }
}

/// Every second view has a vignette. Once it is undone, all views are alike again.
#[test]
fn undone_vignettes_leave_equal_colours() {
    let place = PhotographPlace { middle: [30.0, 30.0], pixel: [1.0 / 60.0; 2] };
    let vignette = Vignette { coefficients: [-1.2, 0.2, 0.0], place };
    let squares = (SIZE / 3) as usize;
    let (tracks, views) = scene(|view, square, value| {
        let (x, y) = (3 * (square % squares) + 1, 3 * (square / squares) + 1);
        let [dimmed, ..] = vignette.apply(x, y, 1.0, [value / 255.0; 3]);
        if view.is_multiple_of(2) { 255.0 * dimmed } else { value }
    });
    let mut colours = TrackColours::read(&tracks, &views).unwrap();
    let apart = |colours: &TrackColours| (colours.gains(0)[1] / colours.gains(1)[1] - 1.0).abs();
    let before = measure(&tracks, &colours).twentieth;
    assert!(before > 2.0 && apart(&colours) > 0.05, "{before} {}", apart(&colours));
    let of_views: Vec<_> =
        (0..VIEWS).map(|view| view.is_multiple_of(2).then_some(vignette)).collect();
    colours.undo_vignettes(&tracks, &views, &of_views);
    let after = measure(&tracks, &colours).twentieth;
    assert!(after < 1.0 && apart(&colours) < 0.02, "{after} {}", apart(&colours));
}

#[test]
fn occlusion_in_a_quarter_of_the_views_is_ignored() {
    let hidden = |count: usize| {
        let (tracks, views) = scene(|view, _, v| if view < count { 255.0 - v } else { v });
        measured(&tracks, &views).unwrap().twentieth
    };
    assert!(hidden(2) < 0.75, "{}", hidden(2));
    assert!(hidden(4) > 4.0, "{}", hidden(4));
}

#[test]
fn no_degree_is_chosen_if_most_points_are_not_on_a_surface() {
    let (mut tracks, views) = scene(|_, _, value| value);
    let on = measured(&tracks, &views).unwrap();
    assert!(on.on_surface > 0.99, "{on:?}");
    for colour in tracks.colours.iter_mut().step_by(3) {
        *colour = colour.map(|value| 255 - value);
    }
    let some = Spread { tracks: MIN_TRACKS, ..measured(&tracks, &views).unwrap() };
    assert!(some.degree().is_some(), "{some:?}");
    let none = Spread { on_surface: 0.49, ..some };
    assert_eq!(none.degree(), None);
    assert_eq!(Spread { tracks: MIN_TRACKS - 1, ..some }.degree(), None);
    assert_eq!(measured(&Tracks::default(), &views).unwrap().degree(), None);
}

#[test]
#[ignore = "takes minutes: run by .ci/run"]
fn built_in_scenes_get_the_degree_that_their_materials_need() {
    for (name, degrees) in [("spheres", 0..=0), ("room", 0..=0), ("glossy", 2..=3)] {
        let options = LoadOptions { tracks: TrackReading::Views, ..LoadOptions::default() };
        let path = format!("{PREFIX}{name}");
        let loaded = Dataset::load(Path::new(&path), &options).unwrap();
        let found = measured(&loaded.tracks, &loaded.train).unwrap();
        let degree = found.degree();
        assert!(degree.is_some_and(|degree| degrees.contains(&degree)), "{name}: {found:?}");
    }
}
