//! ImageError error: one model, rendered with a knob at a level and by the float64 renderer, pixel by
//! pixel.

use std::path::Path;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use crate::backend::Backend;
use crate::backend::cpu::{CpuBackend, CpuOptions};
use crate::camera::Camera;
use crate::failure::{Failure, OTHER};
use crate::gaussians::Gaussians;
use crate::knobs::{Knobs, find};
use crate::output::model_path;
use crate::run::finished::{iteration, load, read_model};
use crate::run::{Observer, RunConfig};
use crate::study::cell::Cell;
use crate::study::record::ImageError;
use crate::verify::reference::{Model, Rules, View, pixels};

/// Views looked at, evenly spread over those held out.
const VIEWS: usize = 4;
/// Pixels looked at in each: the float64 renderer visits every row in each of them.
const PIXELS: usize = 1024;

/// A trained model, and the truth about some of its pixels.
pub(super) struct Subject {
    model: Gaussians,
    near: f32,
    background: [f32; 3],
    views: Vec<SampledView>,
}

/// A view with some pixels.
struct SampledView {
    camera: Camera,
    pixels: Vec<[u32; 2]>,
    /// By the standard rules, and with everything blended.
    truth: [Vec<[f64; 3]>; 2],
}

impl Subject {
    /// The model of a run, in the views that it held out.
    pub(super) fn read(folder: &Path, observer: &dyn Observer) -> Result<Self, Failure> {
        let config = RunConfig::read(folder)?;
        let dataset = load(&config.scene_path(), &config.spec.data, observer)?;
        let path = model_path(folder, iteration(folder, None)?);
        let model = dataset.normalisation.model_from_world(read_model(&path, observer)?);
        let near = (config.spec.start.near.0 * dataset.extent()) as f32;
        let background = config.spec.data.background.fixed();
        let count = dataset.test.len();
        let chosen = (0..VIEWS.min(count)).map(|i| i * count / VIEWS.min(count));
        let views =
            chosen.map(|i| SampledView::new(&model, dataset.test[i].camera, near, background, i));
        Ok(Self { views: views.collect(), model, near, background })
    }

    /// The error with a knob at a level.
    pub(super) fn measure(
        &self,
        cell: &Cell,
        knob: &str,
        level: &str,
    ) -> Result<ImageError, Failure> {
        let mut knobs = Knobs::default();
        if find(knob).is_ok() {
            knobs.set(knob, level).map_err(|error| Failure::input(format!("--knobs: {error}")))?;
        }
        let mut options = CpuOptions::new(self.model.len().max(1));
        options.near = self.near;
        options.shortcuts = knobs.shortcuts;
        options.storage = knobs.storage;
        if let ("tile_cap", Ok(cap)) = (knob, level.parse()) {
            options.tile_cap = cap;
        }
        let mut backend = CpuBackend::new(&self.model, &options)?;
        let (mut squares, mut worst, mut count) = ([0.0; 2], 0.0_f64, 0.0);
        for view in &self.views {
            let image = backend.render(&view.camera, self.background, self.model.sh_degree)?;
            for (i, &[x, y]) in view.pixels.iter().enumerate() {
                let at = 3 * (y * view.camera.width + x) as usize;
                for channel in 0..3 {
                    let shown = f64::from(image.rgb[at + channel]).clamp(0.0, 1.0);
                    let off = [0, 1].map(|k| shown - view.truth[k][i][channel].clamp(0.0, 1.0));
                    squares[0] += off[0] * off[0];
                    squares[1] += off[1] * off[1];
                    worst = worst.max(off[0].abs());
                    count += 1.0;
                }
            }
        }
        if count == 0.0 {
            return Err(Failure { code: OTHER, message: "no pixel to look at".into() });
        }
        // Beyond this is nothing that eight or sixteen bits could show.
        let psnr = |squares: f64| (-10.0 * (squares / count).log10()).min(200.0);
        Ok(ImageError {
            densify: env!("CARGO_PKG_VERSION").to_owned(),
            scene: cell.label.clone(),
            knob: knob.to_owned(),
            level: level.to_owned(),
            spec: cell.spec.clone().into_table(),
            standard: psnr(squares[0]),
            everything: psnr(squares[1]),
            worst,
        })
    }
}

impl SampledView {
    fn new(
        model: &Gaussians,
        camera: Camera,
        near: f32,
        background: [f32; 3],
        number: usize,
    ) -> Self {
        // The same pixels at every call.
        let mut draws = ChaCha8Rng::seed_from_u64(number as u64);
        let place = |_| [camera.width, camera.height].map(|side| draws.random_range(0..side));
        let sampled: Vec<[u32; 2]> = (0..PIXELS).map(place).collect();
        let exact = Model::of(model);
        let sh_degree = model.sh_degree;
        let view = View { camera: &camera, background: background.map(f64::from), sh_degree };
        let truth = [Rules::STANDARD, Rules::SMOOTH].map(|rules| {
            let rules = Rules { near: f64::from(near), ..rules };
            let parts = sampled.par_chunks(64).map(|some| pixels(&exact, view, &rules, some));
            parts.collect::<Vec<_>>().concat()
        });
        Self { camera, pixels: sampled, truth }
    }
}
