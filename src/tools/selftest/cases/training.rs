//! Whole training runs on small images, with intermediate checks: no number drifts, and the budget is kept.

use std::sync::Arc;

use densify_policies::policy::{PixelLoss, SceneInfo};
use densify_policies::registry::find;
use glam::{DMat3, DVec3};

use super::UPRIGHT;
use crate::scenes;
use crate::subject::Subject;
use crate::trial::{Trial, count_non_finite};
use densify_core::camera::Camera;
use densify_core::gaussians::Gaussians;
use densify_core::image::{Image8, SharedImage};
use densify_data::dataset::PointCloud;
use densify_data::views::{ViewError, ViewSource};
use densify_render::{BackendError, Setup};
use densify_train::init::initialise;
use densify_train::schedule::{Background, RateOptions};
use densify_train::trainer::{OnNan, TrainOptions, Trainer};

const SIDE: u32 = 64;
const VIEWS: u32 = 7;
const BUDGET: usize = 400;
/// Policies that together use every kind of edit: splits, clones, resets, relocation, noise, compensation.
const POLICIES: [&str; 3] = ["vanilla", "mcmc", "diet"];

struct Photographs {
    cameras: Vec<Camera>,
    images: Vec<SharedImage>,
}

impl ViewSource for Photographs {
    fn count(&self) -> usize {
        self.cameras.len()
    }

    fn name(&self, _: usize) -> &str {
        "a photograph of the selftest"
    }

    fn camera(&self, view: usize) -> &Camera {
        &self.cameras[view]
    }

    fn image(&self, view: usize) -> Result<SharedImage, ViewError> {
        Ok(self.images[view].clone())
    }
}

/// Cameras on a circle around the origin that look at it.
fn cameras() -> Vec<Camera> {
    let around = |view: u32| {
        let angle = std::f64::consts::TAU * f64::from(view) / f64::from(VIEWS);
        Camera {
            width: SIDE,
            height: SIDE,
            fx: 60.0,
            fy: 60.0,
            cx: 0.5 * f64::from(SIDE),
            cy: 0.5 * f64::from(SIDE),
            rotation: DMat3::from_rotation_y(angle),
            translation: DVec3::new(0.0, 0.0, 1.0),
        }
    };
    (0..VIEWS).map(around).collect()
}

/// The photographed scene: small blobs of all colours in a ball.
fn blobs() -> Gaussians {
    let mut model = Gaussians::default();
    for i in 0..150_u16 {
        let t = f64::from(i);
        let place = [0.35 * (t * 0.7).sin(), 0.35 * (t * 1.1).sin(), 0.35 * (t * 1.9).sin()];
        let scale = [0.02, 0.03, 0.045].map(|s: f32| s * (1.0 + f32::from(i % 5)));
        let shade = |k: usize| f32::from((i * 7 + k as u16 * 5) % 13) * 0.2 - 1.2;
        scenes::push(&mut model, place.map(|x| x as f32), scale, UPRIGHT, 1.5, shade);
    }
    model
}

fn photographs() -> Result<Photographs, BackendError> {
    // The native backend renders them, so that every backend trains on the same photographs.
    let mut native = Subject::NATIVE.backend(&blobs())?;
    let cameras = cameras();
    let mut images = Vec::new();
    for camera in &cameras {
        let image = native.render(camera, [0.0; 3], 0)?;
        let rgb = image.rgb.iter().map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8).collect();
        images.push(Arc::new(Image8 { width: SIDE, height: SIDE, rgb, alpha: None, mask: None }));
    }
    Ok(Photographs { cameras, images })
}

/// Number of parameters outside of the optimiser's limits.
fn count_out_of_range(model: &Gaussians) -> usize {
    let norm = |q: &[f32; 4]| q.iter().map(|v| v * v).sum::<f32>().sqrt();
    // NaN is outside of every range.
    let outside = |x: &f32, from: f32, to: f32| !(from..=to).contains(x);
    let quats = model.quats.iter().filter(|q| outside(&norm(q), 0.5, 2.0)).count();
    let logits = model.opacity_logits.iter().filter(|x| outside(x, -9.2, 9.2)).count();
    let scales = model.log_scales.as_flattened().iter().filter(|x| outside(x, -13.8, 2.3)).count();
    quats + logits + scales + count_non_finite(&[model.means.as_flattened(), &model.sh])
}

pub(super) fn run(trial: &mut Trial<'_>) -> Result<(), BackendError> {
    for policy in POLICIES {
        if let Err(error) = train(trial, policy) {
            trial.table.fail(format!("{policy}: {error}"));
        }
    }
    Ok(())
}

fn train(trial: &mut Trial<'_>, name: &str) -> Result<(), Box<dyn std::error::Error>> {
    let iterations = if trial.long { 30_000 } else { 600 };
    let blobs = blobs();
    let points = PointCloud {
        positions: blobs.means.iter().map(|p| DVec3::from(p.map(f64::from))).collect(),
        colours: vec![[128; 3]; blobs.len()],
    };
    let (model, _) = initialise(&points, BUDGET, 3, 1)?;
    let scene = SceneInfo {
        extent: 1.1,
        train_views: VIEWS,
        budget: BUDGET,
        initial_rows: model.len(),
        iterations,
        white_background: false,
    };
    let options = TrainOptions {
        iterations,
        seed: 5,
        sh_degree: 3,
        background: Background::Black,
        rates: RateOptions::for_run(iterations, PixelLoss::L1),
        prefetch: 1,
        frozen: 0,
        has_all_bands: false,
        on_nan: OnNan::Stop,
        depth: None,
        distortion: 0.0,
        removes_floaters: false,
    };
    let policy = find(name)?.build(&toml::Table::new(), &scene)?;
    let needs = policy.needs(&scene);
    let setup = Setup { budget: BUDGET.into(), needs, ..Setup::default() };
    let backend = trial.subject.backend_with(&model, setup)?;
    let mut trainer = Trainer::new(photographs()?, backend, (name, policy), scene, options)?;
    let (mut over_budget, mut broken, mut checks) = (0, 0, 0);
    let (mut first, mut last) = (0.0, 0.0);
    for step in 1..=iterations {
        let report = trainer.step()?;
        over_budget += usize::from(report.rows > BUDGET || trainer.progress().peak_rows > BUDGET);
        broken += usize::from(!report.output.loss.is_finite());
        // Midway between two edits, as a number may be out of range from an edit until the next step.
        if step % 100 == 50 {
            broken += count_out_of_range(&trainer.model()?) + trainer.backend().audit()?.len();
            checks += 1;
        }
        first += if step <= 50 { f64::from(report.output.loss) } else { 0.0 };
        last += if step + 50 > iterations { f64::from(report.output.loss) } else { 0.0 };
    }
    let label = format!("{name}, {iterations} steps, {checks} checks");
    trial.count(&label, "steps over the budget", over_budget);
    trial.count(&label, "numbers out of range", broken);
    trial.record(&label, "final loss, relative to the initial loss", last / first, 0.5);
    Ok(())
}
