//! Depth in the loss: the gradients of the float64 renderer against central differences, those of every backend against
//! the float64 renderer, and no effect, time or memory where it is off.

use densify::core::camera::Camera;
use densify::core::gaussians::Gaussians;
use densify::core::image::Image8;
use densify::core::image::depth::DepthMap;
use densify::render::{Backend, DepthTarget, DepthTerm, Differentiable, StepInput, StepOutput};
use densify::selftest::compare::{Table, relative_error};
use densify::selftest::reference::depth::{DepthLoss, Ray};
use densify::selftest::reference::loss::loss;
use densify::selftest::reference::project::{self, Splat, by_depth};
use densify::selftest::reference::{CLASSES, Model, Rules, Upstream, View, blend};
use densify::selftest::{Setup, Subject, scenes};
use densify_policies::policy::{Needs, PixelLoss, Signal, SignalSet};

use crate::subject::{BLUE, all, make_with, normalised, repeatable, step_input};

/// Step of the central difference, to either side.
const STEP: f64 = 1e-6;

/// What is in the loss: a term for the given depth, and the weight of the distortion.
#[derive(Debug, Clone, Copy)]
struct Terms {
    given: Option<(DepthTerm, f32)>,
    distortion: f32,
}

const EXPECTED: Terms = Terms { given: Some((DepthTerm::Expected, 20.0)), distortion: 0.0 };
const SAMPLES: Terms = Terms { given: Some((DepthTerm::Samples, 20.0)), distortion: 0.0 };
const DISTORTION: Terms = Terms { given: None, distortion: 30.0 };
const ALL_TERMS: [(&str, Terms); 5] = [
    ("expected", EXPECTED),
    ("samples", SAMPLES),
    ("distortion", DISTORTION),
    ("expected and distortion", Terms { distortion: 30.0, ..EXPECTED }),
    ("samples and distortion", Terms { distortion: 30.0, ..SAMPLES }),
];

struct Scene {
    model: Gaussians,
    camera: Camera,
    target: Image8,
    map: DepthMap,
}

/// Translucent Gaussians, given depth with holes and uncertain pixels, and a mask of all values. Pixels in which f32
/// may decide a threshold differently are masked.
fn scene(width: u32, height: u32, rows: usize) -> Scene {
    let camera = scenes::camera(width, height, 81);
    let model = normalised(scenes::cloud(rows, 1, &camera, 82));
    let pixels = (width * height) as usize;
    // 1/z between 0.15 and 0.65, as depths lie between 2 and 5.
    let inverse = |p: usize| if p % 5 == 3 { 0 } else { (1500 + p * 7919 % 5000) as u16 };
    let confidence = |p: usize| if p % 7 == 2 { 0 } else { (55 + p * 31 % 201) as u8 };
    let map = DepthMap {
        width,
        height,
        inverse: (0..pixels).map(inverse).collect(),
        confidence: (0..pixels).map(confidence).collect(),
        unit: 1e-4,
        median: 2.5,
    };
    let view = View { camera: &camera, background: [0.0; 3], sh_degree: 1 };
    let boundary = {
        let model = Model::from(&model);
        let splats = project::project(&model, view, &Rules::STANDARD);
        blend::render(&splats, &by_depth(&splats), view, &Rules::STANDARD).boundary
    };
    let mask = |p: usize| if boundary[p] || p % 11 == 4 { 0 } else { (35 + p * 13 % 221) as u8 };
    let target = Image8 { mask: Some((0..pixels).map(mask).collect()), ..scenes::target(&camera) };
    Scene { model, camera, target, map }
}

impl Scene {
    fn view(&self) -> View<'_> {
        View { camera: &self.camera, background: BLUE.map(f64::from), sh_degree: 1 }
    }

    fn reference(&self, terms: Terms) -> DepthLoss {
        let map = terms.given.map(|_| &self.map);
        let (term, weight) = terms.given.unwrap_or_default();
        let pixels = self.map.inverse.len();
        let mask = self.target.mask.as_deref();
        DepthLoss::new(map, mask, pixels, (term, weight.into()), terms.distortion.into())
    }

    fn input(&self, step: u32, terms: Terms) -> StepInput<'_> {
        let depth = terms.given.map(|(term, weight)| DepthTarget { map: &self.map, weight, term });
        let distortion = terms.distortion;
        StepInput { depth, distortion, ..step_input(step, &self.camera, &self.target, 1) }
    }
}

fn rays(splats: &[Splat], order: &[usize], view: View<'_>, rules: &Rules) -> Vec<Ray> {
    let samples = |ray: Vec<(usize, f64)>| -> Ray {
        ray.into_iter().map(|(row, weight)| [weight, splats[row].depth]).collect()
    };
    blend::rays(splats, order, view, rules).into_iter().map(samples).collect()
}

/// The gradient of depth in the loss, and of Σ image · upstream.
fn gradient(scene: &Scene, loss: &DepthLoss, rules: &Rules, upstream: &Upstream) -> Model {
    let (model, view) = (Model::from(&scene.model), scene.view());
    let splats = project::project(&model, view, rules);
    let order = by_depth(&splats);
    let by_sample = loss.gradient(&rays(&splats, &order, view, rules));
    let screen = blend::backward_along_rays(&splats, &order, view, rules, upstream, &by_sample);
    project::backward(&model, view, &splats, &screen)
}

fn no_upstream(pixels: usize) -> Upstream {
    Upstream { rgb: vec![0.0; 3 * pixels], alpha: vec![0.0; pixels], depth: vec![0.0; pixels] }
}

#[test]
fn reference_gradients_match_central_differences() {
    let mut table = Table::new("depth in the loss against central differences");
    let scene = scene(13, 11, 7);
    let (model, view) = (Model::from(&scene.model), scene.view());
    let pixels = scene.map.inverse.len();
    let order = by_depth(&project::project(&model, view, &Rules::SMOOTH));
    let rays = |model: &Model| {
        rays(&project::project(model, view, &Rules::SMOOTH), &order, view, &Rules::SMOOTH)
    };
    let frozen = rays(&model);
    for (case, terms) in ALL_TERMS {
        let loss = scene.reference(terms);
        let analytic = gradient(&scene, &loss, &Rules::SMOOTH, &no_upstream(pixels));
        let largest = CLASSES
            .iter()
            .flat_map(|class| analytic.class(class))
            .fold(0.0_f64, |m, g| m.max(g.abs()));
        assert!(largest > 0.01, "{case}: gradients of at most {largest}");
        for class in CLASSES {
            let mut moved = model.clone();
            let mut differences = Vec::new();
            for i in 0..model.class(class).len() {
                let at = model.class(class)[i];
                let mut value = |by: f64| {
                    moved.class_mut(class)[i] = at + by;
                    loss.value(&rays(&moved), &frozen)
                };
                differences.push((value(STEP) - value(-STEP)) / (2.0 * STEP));
                moved.class_mut(class)[i] = at;
            }
            let expected = analytic.class(class);
            let worst = expected.iter().zip(&differences).map(|(a, b)| (a - b).abs());
            let worst = worst.fold(0.0, |m: f64, d| if d.is_nan() { d } else { m.max(d) });
            table.check(case, class, worst / largest, 1e-6);
        }
    }
    table.finish();
}

/// The backends' gradients of the geometry in the first step, from the first moment, which is a tenth of them.
/// Shape: [rows, 11].
fn measured(backend: &dyn Differentiable) -> Vec<[f64; 11]> {
    let names = ["moments.first", "device.first rows"];
    let state = backend.state();
    let name = names.iter().find(|name| state.iter().any(|array| array.name == **name));
    let tensor = backend.save(name.expect("moments of the geometry")).expect("an array");
    let shape = tensor.shape.clone();
    let values = tensor.into_f32(&shape).expect("numbers");
    let row = |row: &[f32]| std::array::from_fn(|i| 10.0 * f64::from(row[i]));
    values.chunks(shape[1]).map(row).collect()
}

/// dL/d(colours) of the image loss; the mask multiplies the difference.
fn image_gradient(scene: &Scene) -> Upstream {
    let (model, view) = (Model::from(&scene.model), scene.view());
    let splats = project::project(&model, view, &Rules::STANDARD);
    let image = blend::render(&splats, &by_depth(&splats), view, &Rules::STANDARD);
    let (width, height) = (scene.camera.width as usize, scene.camera.height as usize);
    let mask = scene.target.mask.as_ref().expect("a mask");
    let truth: Vec<f64> = scene.target.rgb.iter().map(|&v| f64::from(v) / 255.0).collect();
    let at = |i: usize| f64::from(mask[i / 3]) / 255.0;
    let compared: Vec<f64> =
        (0..truth.len()).map(|i| truth[i] + at(i) * (image.rgb[i] - truth[i])).collect();
    let by_colour = loss(&compared, &truth, (width, height), PixelLoss::L1).gradient;
    let rgb = by_colour.iter().enumerate().map(|(i, g)| at(i) * g).collect();
    Upstream { rgb, ..no_upstream(width * height) }
}

#[test]
fn gradients_of_backends_match_the_reference() {
    let mut table = Table::new("depth in the loss against float64");
    let scene = scene(37, 29, 14);
    let upstream = image_gradient(&scene);
    let (model, view) = (Model::from(&scene.model), scene.view());
    let splats = project::project(&model, view, &Rules::STANDARD);
    let rays = rays(&splats, &by_depth(&splats), view, &Rules::STANDARD);
    for (case, terms) in ALL_TERMS {
        let loss = scene.reference(terms);
        let exact = gradient(&scene, &loss, &Rules::STANDARD, &upstream);
        // Errors of rows have a field of their own beside depth.
        for signals in [SignalSet::default(), SignalSet::from([Signal::WeightedError])] {
            for subject in all() {
                let needs = Needs { signals, ..Needs::default() };
                let setup = Setup { depth: true, needs, tile_cap: Some(60), ..Setup::default() };
                let mut backend = make_with(&subject, &scene.model, setup);
                let output = backend.train_step(&scene.input(1, terms)).expect("a step");
                let case = format!("{case}, {}, {signals:?}", subject.name());
                let value = terms.given.map(|_| loss.term_value(&rays));
                assert_eq!(output.depth.is_some(), value.is_some(), "{case}");
                let error = f64::from(output.depth.unwrap_or_default()) - value.unwrap_or_default();
                table.check(&case, "value", error.abs(), 1e-5);
                let tolerance = 10.0 * subject.gradient_tolerance();
                let rows = measured(&*backend);
                let of = |first: usize, count: usize| -> Vec<f64> {
                    rows.iter().flat_map(|row| row[first..first + count].to_vec()).collect()
                };
                for (name, found) in [
                    ("means", of(0, 3)),
                    ("log_scales", of(3, 3)),
                    ("quats", of(6, 4)),
                    ("opacity_logits", of(10, 1)),
                ] {
                    table.check(&case, name, relative_error(&found, exact.class(name)), tolerance);
                }
            }
        }
    }
    table.finish();
}

/// The bits of a model.
fn bits(backend: &dyn Backend) -> Vec<u32> {
    let model = backend.download().expect("the model");
    let arrays = [
        model.means.as_flattened(),
        model.log_scales.as_flattened(),
        model.quats.as_flattened(),
        &model.opacity_logits,
        &model.sh,
    ];
    arrays.concat().iter().map(|value| value.to_bits()).collect()
}

fn train(
    subject: &Subject,
    scene: &Scene,
    setup: Setup,
    terms: Terms,
) -> (Vec<u32>, Vec<StepOutput>) {
    let mut backend = make_with(subject, &scene.model, setup);
    let step = |i| backend.train_step(&scene.input(i, terms)).expect("a step");
    let outputs: Vec<_> = (1..=4).map(step).collect();
    (bits(&*backend), outputs)
}

const OFF: Terms = Terms { given: None, distortion: 0.0 };

/// A backend that is set up for depth takes the same steps without depth as any other, but more memory.
#[test]
fn steps_without_depth_are_unchanged() {
    let scene = scene(37, 29, 14);
    for subject in repeatable() {
        let run = |depth: bool| {
            let signals = SignalSet::from([Signal::ScreenGradientAbs, Signal::WeightMax]);
            let needs = Needs { signals, ..Needs::default() };
            let setup = Setup { depth, needs, tile_cap: Some(60), ..Setup::default() };
            let bytes = make_with(&subject, &scene.model, setup.clone()).ledger().total();
            (train(&subject, &scene, setup, OFF), bytes)
        };
        let ((without, without_bytes), (with, with_bytes)) = (run(false), run(true));
        assert!(without == with, "{}", subject.name());
        assert!(without_bytes < with_bytes, "{}", subject.name());
    }
}

/// Threads, bands of tile lists and parts of the backward pass change nothing.
#[test]
fn depth_is_reproducible() {
    let scene = scene(50, 37, 40);
    for subject in repeatable() {
        for (case, terms) in ALL_TERMS {
            let run = |tile_cap: usize, record_cap: usize, threads: usize| {
                let mut subject = subject.clone();
                if let Subject::Native { threads: of_subject, .. } = &mut subject {
                    *of_subject = Some(threads);
                }
                let tile_cap = Some(tile_cap);
                let setup = Setup { depth: true, tile_cap, record_cap, ..Setup::default() };
                let (bits, mut outputs) = train(&subject, &scene, setup, terms);
                let bands = outputs[0].bands;
                outputs.iter_mut().for_each(|output| output.bands = 1);
                ((bits, outputs), bands)
            };
            let (whole, _) = run(10_000, usize::MAX, 1);
            for (tile_cap, record_cap, threads) in
                [(10_000, usize::MAX, 3), (60, usize::MAX, 2), (10_000, 7, 2)]
            {
                let (other, bands) = run(tile_cap, record_cap, threads);
                assert!(tile_cap > 60 || bands > 1, "one band");
                let case = format!("{case}, {}, {tile_cap}, {record_cap}", subject.name());
                assert!(other == whole, "{case}");
            }
        }
    }
}

/// Without any confident pixel, the term is 0 and nothing is divided by it.
#[test]
fn maps_without_depth_have_no_effect() {
    let mut scene = scene(37, 29, 14);
    scene.map.confidence.fill(0);
    for subject in repeatable() {
        let setup = || Setup { depth: true, tile_cap: Some(60), ..Setup::default() };
        let without = train(&subject, &scene, setup(), OFF);
        for terms in [EXPECTED, SAMPLES] {
            let (bits, outputs) = train(&subject, &scene, setup(), terms);
            assert!(bits == without.0, "{}: {terms:?}", subject.name());
            assert!(outputs.iter().all(|output| output.depth == Some(0.0)), "{outputs:?}");
        }
    }
}
