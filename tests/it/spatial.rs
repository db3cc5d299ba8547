//! A policy with spatial rules, written against the public interface and run by the trainer on every backend. It reads
//! positions and appearance, and the test checks that its plan is carried out.

#![expect(clippy::float_cmp, reason = "positions must match bit for bit")]

use std::sync::Arc;

use densify::core::camera::Camera;
use densify::core::gaussians::{Gaussians, dc_to_rgb};
use densify::core::image::SharedImage;
use densify::data::views::{ViewError, ViewSource};
use densify::render::Backend;
use densify::selftest::reference::View;
use densify::selftest::{Setup, scenes};
use densify::train::schedule::{Background, RateOptions};
use densify::train::trainer::{OnNan, TrainOptions, Trainer};
use densify_policies::adc::clone_at;
use densify_policies::conformance::check_policy;
use densify_policies::parameters::StepParameter;
use densify_policies::plan::{EditPlan, Offspring, ParentFate, Placement, ScaleRule, Update};
use densify_policies::policy::{
    DensityPolicy, Needs, PolicyError, SceneInfo, Signal, SignalSet, Snapshot,
};
use densify_policies::registry::{ConfiguredPolicy, PolicyEntry};
use densify_policies::rng::PolicyRng;

use crate::signals::reference;
use crate::subject::{make_with, normalised, on_each, repeatable};

/// The step of the event.
const STEP: u32 = 3;
/// Displacement along x of the rows that are not split.
const SHIFT: f32 = 0.25;
/// Offspring half a standard deviation to either side along the second axis.
const HALVES: Placement = Placement::Axes([0.0, 0.5, 0.0]);
/// Offspring half as long along the second axis.
const HALVED: ScaleRule = ScaleRule::Axes([1.0, 0.5, 1.0]);
/// A quarter turn about the first axis.
const QUARTER: [f32; 4] = [1.0, 1.0, 0.0, 0.0];

/// Rows with x > `left` are split in two; the others move along x and are tinted by their mean error.
#[derive(Clone, Copy, Default, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Spatial {
    left: f32,
}

impl ConfiguredPolicy for Spatial {
    type Params = Self;
    const STEP_PARAMETERS: &'static [StepParameter] = &[];
    fn new(params: Self, _: &SceneInfo) -> Result<Self, PolicyError> {
        Ok(params)
    }
}

impl DensityPolicy for Spatial {
    fn needs(&self, _: &SceneInfo) -> Needs {
        let read = [Signal::Position, Signal::Colour, Signal::WeightedError, Signal::WeightSum];
        Needs { signals: SignalSet::from(read), detailed_edits: true, ..Needs::default() }
    }

    fn is_due(&self, step: u32) -> bool {
        step == STEP
    }

    fn plan(
        &mut self,
        now: &Snapshot<'_>,
        _: &PolicyRng,
        plan: &mut EditPlan,
    ) -> Result<(), PolicyError> {
        let (errors, weights) =
            (now.signal(Signal::WeightedError)?, now.signal(Signal::WeightSum)?);
        let split = Offspring {
            parent: ParentFate::BecomesChild,
            placement: HALVES,
            scale: HALVED,
            turn: QUARTER,
            ..clone_at([0.0; 3])
        };
        let rows = now.positions()?.iter().zip(now.colours()?);
        for (row, (position, [red, green, _])) in (0..).zip(rows) {
            let [x, y, z] = *position;
            let mean_error = errors[row as usize] / weights[row as usize].max(1e-6);
            let (position, colour) = (Some([x + SHIFT, y, z]), Some([*red, *green, mean_error]));
            // The plan counts refused edits.
            let _ = match x > self.left {
                true => plan.grow(row, split),
                false => plan.update(row, Update { position, colour, ..Update::NONE }),
            };
        }
        plan.cause("spatial");
        Ok(())
    }
}

#[test]
fn policy_conforms() {
    let entry = PolicyEntry::new::<Spatial>("spatial", "for tests", "nowhere", "", (file!(), 1));
    check_policy(&entry).unwrap_or_else(|report| panic!("{report}"));
}

/// A dataset of one view.
struct OneView(Camera, SharedImage);

impl ViewSource for OneView {
    fn count(&self) -> usize {
        1
    }
    fn name(&self, _: usize) -> &str {
        "one"
    }
    fn camera(&self, _: usize) -> &Camera {
        &self.0
    }
    fn image(&self, _: usize) -> Result<SharedImage, ViewError> {
        Ok(Arc::clone(&self.1))
    }
}

/// The model after the event, with negligible learning rates, and the number of refused edits.
fn trained(policy: Spatial, backend: Box<dyn Backend>, camera: &Camera) -> (Gaussians, usize) {
    let budget = backend.budget();
    let scene = scene_of(budget);
    let negligible = 1e-30;
    let rates = RateOptions {
        mean_start: f64::from(negligible),
        mean_end: f64::from(negligible),
        log_scale: negligible,
        quat: negligible,
        opacity: negligible,
        sh_dc: negligible,
        sh_rest: negligible,
        ..RateOptions::default()
    };
    let options = TrainOptions {
        iterations: STEP,
        seed: 7,
        sh_degree: 1,
        background: Background::Black,
        rates,
        prefetch: 0,
        frozen: 0,
        has_all_bands: false,
        on_nan: OnNan::Stop,
        depth: None,
        distortion: 0.0,
        removes_floaters: false,
    };
    let views = OneView(*camera, Arc::new(scenes::target(camera)));
    let policy: Box<dyn DensityPolicy> = Box::new(policy);
    let mut trainer = Trainer::new(views, backend, ("spatial", policy), scene, options)
        .expect("a policy that declares what it reads");
    let events: Vec<_> =
        (0..STEP).flat_map(|_| trainer.step().expect("a small image").events).collect();
    assert_eq!((events.len(), events[0].cause.as_str()), (1, "spatial"));
    (trainer.backend().download().expect("a model"), events[0].denied)
}

#[test]
fn rows_are_split_moved_and_painted_by_position() {
    let camera = scenes::camera(45, 37, 31);
    let mut model = normalised(scenes::cloud(30, 1, &camera, 32));
    for (mean, i) in model.means.iter_mut().zip(0_u8..) {
        // In front of the camera at distinct depths.
        *mean = scenes::world(&camera, [0.05 * f64::from(i) - 0.7, 0.0, 3.0 + 0.02 * f64::from(i)]);
    }
    let spatial = Spatial { left: model.means[12][0] };
    let inside: Vec<usize> = (0..30).filter(|&row| model.means[row][0] > spatial.left).collect();
    assert!((5..25).contains(&inside.len()), "{inside:?}");
    let view = View { camera: &camera, background: [0.0; 3], sh_degree: 1 };
    let (gradient, errors, _) = reference(&model, view, &scenes::target(&camera));
    let mean_error = |row: usize| errors[row] / gradient.screen[row].sum_weight;
    on_each(repeatable(), |subject| {
        // Two splits are refused.
        let needs = spatial.needs(&scene_of(28));
        let setup = Setup { budget: (28 + inside.len()).into(), needs, ..Setup::default() };
        let (after, denied) = trained(spatial, make_with(subject, &model, setup), &camera);
        assert_eq!((after.len(), denied), (28 + inside.len(), 2));
        // The new index of a row, after the children of earlier rows.
        let mut next = 0;
        for row in 0..30 {
            let place = next;
            next += 1;
            let ([x, y, z], dc) = (model.means[row], &model.sh_of(row)[..3]);
            if !inside.contains(&row) {
                assert_eq!(after.means[place], [x + SHIFT, y, z], "row {row}");
                let [red, green, blue] = [0, 1, 2].map(|c| dc_to_rgb(after.sh_of(place)[c]));
                assert!((red - dc_to_rgb(dc[0])).abs() + (green - dc_to_rgb(dc[1])).abs() < 1e-5);
                let mean_error = mean_error(row);
                assert!(mean_error > 0.01, "row {row} is not visible");
                assert!(
                    (f64::from(blue) - mean_error).abs() < 2e-3 * mean_error,
                    "row {row}: a mean error of {blue}, not {mean_error}"
                );
                assert_eq!(after.sh_of(place)[3..], model.sh_of(row)[3..], "row {row}");
                continue;
            }
            if inside[inside.len() - 2..].contains(&row) {
                assert_eq!(after.means[place], [x, y, z], "row {row} was refused");
                continue;
            }
            let mid = [0, 1, 2].map(|i| 0.5 * (after.means[place][i] + after.means[next][i]));
            assert!(close(mid, [x, y, z]), "row {row}: {mid:?}");
            let [a, b, c] = model.log_scales[row];
            for part in [place, next] {
                assert!(close(after.log_scales[part], [a, b - 2.0_f32.ln(), c]), "row {part}");
                let offset =
                    [0, 1, 2].map(|i| f64::from(after.means[part][i] - model.means[row][i]));
                // Half a standard deviation along the second axis, which the rotation turns into the third.
                let axis = column(model.quats[row], 1);
                let along: f64 = (0..3).map(|i| offset[i] * axis[i]).sum();
                assert!((along.abs() - 0.5 * f64::from(b).exp()).abs() < 1e-5, "row {part}");
                let turned: f64 = (0..3).map(|i| column(after.quats[part], 2)[i] * axis[i]).sum();
                assert!((turned + 1.0).abs() < 1e-5, "row {part}: {turned}");
            }
            next += 1;
        }
    });
}

fn scene_of(rows: usize) -> SceneInfo {
    SceneInfo {
        extent: 3.0,
        train_views: 1,
        budget: rows,
        initial_rows: rows,
        iterations: STEP,
        white_background: false,
    }
}

fn close(a: [f32; 3], b: [f32; 3]) -> bool {
    a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-5 * (1.0 + b.abs()))
}

/// An axis of a rotation in scene coordinates.
fn column(quat: [f32; 4], axis: usize) -> [f64; 3] {
    let [w, x, y, z] = quat.map(f64::from);
    let turn = glam::DQuat::from_xyzw(x, y, z, w).normalize();
    glam::DMat3::from_quat(turn).col(axis).to_array()
}
