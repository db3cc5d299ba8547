//! Compares the signals of training with the loss gradients of the reference. One file, because all tests share the
//! views and their references.

use densify::core::camera::Camera;
use densify::core::gaussians::{Gaussians, dc_to_rgb};
use densify::core::image::Image8;
use densify::render::{LearningRates, StepInput, Storage};
use densify_policies::plan::EditPlan;
use densify_policies::policy::{
    ErrorMap, ErrorScore, Needs, PixelLoss, SUPPORT_WEIGHT, Signal, SignalKind, SignalSet,
};

use crate::subject::{all, devices, make_with, normalised, repeatable, step_input, storages};
use densify::selftest::compare::{Table, relative_error};
use densify::selftest::reference::blend::each_blended;
use densify::selftest::reference::loss::{Loss, loss};
use densify::selftest::reference::project::{by_depth, project};
use densify::selftest::reference::{
    Gradient, Image, Model, Rules, Upstream, View, differentiate, render,
};
use densify::selftest::{Differentiable, Setup, Subject, scenes};

/// Twice the tolerance of gradients: the L1 part of the gradient jumps with the sign of render − target, and a few
/// pixels are near a threshold.
const TOLERANCE: f64 = 2e-4;
/// The tolerance of a backend; functions of GPUs are less accurate.
fn tolerance(subject: &Subject) -> f64 {
    if matches!(subject, Subject::Gpu(_)) { 5.0 * TOLERANCE } else { TOLERANCE }
}

/// The share of its pixels that a row may gain or lose at the alpha threshold.
const FLIPPED: f64 = 1e-3;
const BACKGROUND: [f32; 3] = [0.1, 0.3, 0.2];

struct Views {
    model: Gaussians,
    cameras: Vec<Camera>,
    targets: Vec<Image8>,
}

/// Two views of one cloud with different image sizes.
fn views() -> Views {
    let first = scenes::camera(45, 37, 61);
    let mut second = Camera { width: 38, height: 50, ..first };
    second.translation.x += 0.3;
    let cameras = vec![first, scenes::rounded(&second)];
    // Normalised, because even steps with learning rates of 0 normalise quaternions.
    let model = normalised(scenes::cloud(21, 2, &first, 62));
    let target = |camera: &Camera| scenes::noisy((camera.width, camera.height), 0.0, 63).1;
    let mut targets: Vec<_> = cameras.iter().map(target).collect();
    targets[1].mask = Some((0..38 * 50).map(|i| (i * 37 % 256) as u8).collect());
    Views { model, cameras, targets }
}

/// Rendering and training loss of one view by the reference.
fn rendering_and_loss(model: &Model, view: View<'_>, target: &Image8) -> (Image, Loss) {
    let image = render(model, view, &Rules::STANDARD);
    let truth: Vec<f64> = target.rgb.iter().map(|&v| f64::from(v) / 255.0).collect();
    // Masks reduce the error in proportion.
    let mask = |i: usize| target.mask.as_ref().map_or(1.0, |mask| f64::from(mask[i / 3]) / 255.0);
    let pairs = image.rgb.iter().zip(&truth).enumerate();
    let masked: Vec<f64> = pairs.map(|(i, (x, y))| y + mask(i) * (x - y)).collect();
    let size = (view.camera.width as usize, view.camera.height as usize);
    let mut loss = loss(&masked, &truth, size, PixelLoss::L1);
    for (i, gradient) in loss.gradient.iter_mut().enumerate() {
        *gradient *= mask(i);
    }
    (image, loss)
}

/// The reference's results for one view: the gradient of the training loss, the weighted error of each row, and the
/// share of pixels that each row dominates.
pub(crate) fn reference(
    model: &Gaussians,
    view: View<'_>,
    target: &Image8,
) -> (Gradient, Vec<f64>, Vec<f64>) {
    let model = Model::from(model);
    let (image, loss) = rendering_and_loss(&model, view, target);
    let splats = project(&model, view, &Rules::STANDARD);
    let mut errors = vec![0.0; splats.len()];
    let mut largest = vec![(0.0, None); image.alpha.len()];
    each_blended(&splats, &by_depth(&splats), view, &Rules::STANDARD, |pixel, row, weight, _| {
        errors[row] += weight * mixed(loss.by_pixel[pixel], ErrorMap::Loss);
        if weight > largest[pixel].0 {
            largest[pixel] = (weight, Some(row));
        }
    });
    let mut dominated = vec![0.0; splats.len()];
    for row in largest.iter().filter_map(|pixel| pixel.1) {
        dominated[row] += 1.0 / image.alpha.len() as f64;
    }
    let nothing = vec![0.0; image.alpha.len()];
    let upstream = Upstream { rgb: loss.gradient, alpha: nothing.clone(), depth: nothing };
    (differentiate(&model, view, &Rules::STANDARD, &upstream).1, errors, dominated)
}

fn norm(values: impl IntoIterator<Item = f64>) -> f64 {
    values.into_iter().map(|v| v * v).sum::<f64>().sqrt()
}

/// Contribution of one view to a signal. Rows at least `full_depth` away count fully, nearer ones less. Shape: [rows].
fn contribution(
    signal: Signal,
    (gradient, errors, dominated): &(Gradient, Vec<f64>, Vec<f64>),
    camera: &Camera,
    depths: &[f64],
    full_depth: f64,
) -> Vec<f64> {
    let ndc = [0.5 * f64::from(camera.width), 0.5 * f64::from(camera.height)];
    let rows = gradient.screen.iter().zip(&gradient.model.means).zip(depths).zip(errors);
    rows.zip(dominated)
        .map(|((((s, mean), depth), &error), &dominated)| {
            let seen = f64::from(u8::from(s.pixels > 0));
            let focal = 0.5 * (camera.fx + camera.fy);
            let near = if full_depth > 0.0 { (depth / full_depth).min(1.0).powi(2) } else { 1.0 };
            match signal {
                Signal::VisibleCount => seen,
                Signal::ScreenGradient => near * norm([0, 1].map(|i| s.mean[i] * ndc[i])),
                Signal::ScreenGradientAbs => near * norm([0, 1].map(|i| s.mean_abs[i] * ndc[i])),
                Signal::ColourGradient => near * norm(s.colour),
                Signal::MeanGradientX => mean[0],
                Signal::MeanGradientY => mean[1],
                Signal::MeanGradientZ => mean[2],
                Signal::MeanGradientNorm => norm(*mean),
                Signal::WeightMax => s.max_weight,
                Signal::WeightSum => s.sum_weight,
                Signal::PixelCount => f64::from(s.pixels),
                // The default error score is the weighted error.
                Signal::WeightedError | Signal::ErrorScore => error,
                Signal::WeightMaxRoot => s.max_weight.sqrt(),
                Signal::Support => f64::from(u8::from(s.max_weight >= f64::from(SUPPORT_WEIGHT))),
                // Minima are compared as reciprocals.
                Signal::DepthMin => seen / depth,
                Signal::PixelSizeMin => seen * focal / depth,
                Signal::DominantPixels => dominated,
                other => panic!("{other:?} is not accumulated over views"),
            }
        })
        .collect()
}

/// Runs one step per view and takes the signals.
fn collect(
    subject: &Subject,
    views: &Views,
    wanted: &[Signal],
    full_depth: f32,
) -> (Box<dyn Differentiable>, Vec<Vec<f32>>) {
    let needs = Needs { signals: wanted.iter().copied().collect(), full_depth, ..Needs::default() };
    collect_with(subject, views, wanted, needs)
}

/// Like `collect`, with the given needs.
fn collect_with(
    subject: &Subject,
    views: &Views,
    wanted: &[Signal],
    needs: Needs,
) -> (Box<dyn Differentiable>, Vec<Vec<f32>>) {
    let setup = Setup { needs: needs.clone(), ..Setup::default() };
    let mut backend = make_with(subject, &views.model, setup);
    for (v, (camera, target)) in views.cameras.iter().zip(&views.targets).enumerate() {
        let step = step_input(v as u32 + 1, camera, target, 2);
        let input = StepInput { background: BACKGROUND, rates: LearningRates::default(), ..step };
        backend.train_step(&input).expect("a small image is rendered");
    }
    let signals = backend.take_signals(needs.signals).expect("signals can be taken");
    let columns =
        wanted.iter().map(|&s| signals.get(s).expect("a requested signal").to_vec()).collect();
    (backend, columns)
}

#[test]
fn every_signal_matches_in_any_combination() {
    let views = views();
    let pairs = views.cameras.iter().zip(&views.targets);
    let gradients: Vec<_> = pairs
        .map(|(camera, target)| {
            let view = View { camera, background: BACKGROUND.map(f64::from), sh_degree: 2 };
            reference(&views.model, view, target)
        })
        .collect();
    let is_accumulated = |s: &Signal| s.is_resettable() || s.kind() == SignalKind::EpochMaximum;
    let everything: Vec<Signal> = Signal::ALL.into_iter().filter(is_accumulated).collect();
    let mut base = everything.clone();
    base.retain(|signal| signal.pixel_sums().is_empty());
    let depths = |camera: &Camera| -> Vec<f64> {
        let depth = |mean: &[f32; 3]| camera.project(mean.map(f64::from).into()).1;
        views.model.means.iter().map(depth).collect()
    };
    let mut depths_in_first = depths(&views.cameras[0]);
    depths_in_first.sort_by(f64::total_cmp);
    let middle = depths_in_first[depths_in_first.len() / 2] as f32;
    // Each signal is requested alone, with those that need no pixel sums, and with all others, because backends store
    // only requested signals. All are also requested with a reduced weight of near rows.
    let mut requests =
        vec![(base.clone(), 0.0), (everything.clone(), 0.0), (everything.clone(), middle)];
    for &signal in &everything {
        requests.push((vec![signal], 0.0));
        if !base.contains(&signal) {
            requests.push(([&base[..], &[signal]].concat(), 0.0));
        }
    }

    for subject in all() {
        let mut table = Table::new(&format!("signals, {}", subject.name()));
        for (request, full_depth) in &requests {
            let (_, columns) = collect(&subject, &views, request, *full_depth);
            for (&signal, mut column) in request.iter().zip(columns) {
                if signal.kind() == SignalKind::Minimum {
                    column.iter_mut().for_each(|value| *value = 1.0 / *value);
                }
                let mut expected = vec![0.0; views.model.len()];
                for (gradient, camera) in gradients.iter().zip(&views.cameras) {
                    let full_depth = f64::from(*full_depth);
                    let parts = contribution(signal, gradient, camera, &depths(camera), full_depth);
                    for (sum, part) in expected.iter_mut().zip(parts) {
                        let is_sum = matches!(signal.kind(), SignalKind::Sum | SignalKind::Count);
                        *sum = if is_sum { *sum + part } else { part.max(*sum) };
                    }
                }
                let case = format!("{} signals, full from {full_depth}", request.len());
                let error = relative_error(&column, &expected);
                let flips = if signal == Signal::PixelCount { FLIPPED } else { 0.0 };
                table.check(&case, &format!("{signal:?}"), error, tolerance(&subject) + flips);
            }
        }
        table.finish();
    }
}

/// Clipped 8-neighbour Laplacian of the luma at a pixel, with repeated borders.
fn edge(target: &Image8, pixel: usize) -> f64 {
    let (width, height) = (i64::from(target.width), i64::from(target.height));
    let luma = |x: i64, y: i64| {
        let at = 3 * (y.clamp(0, height - 1) * width + x.clamp(0, width - 1)) as usize;
        let [r, g, b] = [0, 1, 2].map(|i| f64::from(target.rgb[at + i]));
        (0.299 * r + 0.587 * g + 0.114 * b).round()
    };
    let (x, y) = (pixel as i64 % width, pixel as i64 / width);
    let around = (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| (x + dx, y + dy)));
    (9.0 * luma(x, y) - around.map(|(x, y)| luma(x, y)).sum::<f64>()).clamp(0.0, 255.0)
}

/// The pixel error from its L1 and SSIM parts.
fn mixed([absolute, dissimilar]: [f64; 2], map: ErrorMap) -> f64 {
    match map {
        ErrorMap::Loss => 0.8 * absolute + 0.2 * dissimilar,
        ErrorMap::L1 => absolute,
        ErrorMap::Dssim => dissimilar,
    }
}

/// The [`ErrorScore`] of each row in one view, from its definition.
fn scores(model: &Gaussians, view: View<'_>, target: &Image8, score: &ErrorScore) -> Vec<f64> {
    let model = Model::from(model);
    let (image, loss) = rendering_and_loss(&model, view, target);
    let edges: Vec<f64> = (0..image.alpha.len()).map(|pixel| edge(target, pixel)).collect();
    let mean = edges.iter().sum::<f64>() / edges.len() as f64;
    assert!(mean > 1.0, "the image has no edges");
    let [power, weight, footprint, view_power] =
        [score.power, score.edge, score.footprint, score.view_power].map(f64::from);
    let splats = project(&model, view, &Rules::STANDARD);
    let mut sums = vec![(0.0, 0.0); splats.len()];
    each_blended(&splats, &by_depth(&splats), view, &Rules::STANDARD, |pixel, row, w, _| {
        let map = mixed(loss.by_pixel[pixel], score.map).powf(power)
            * (1.0 + weight * edges[pixel] / mean);
        sums[row] = (sums[row].0 + w * map, sums[row].1 + w);
    });
    let of_row = |(error, w): (f64, f64)| {
        if error > 0.0 { (error / w.powf(footprint)).powf(view_power) } else { 0.0 }
    };
    sums.into_iter().map(of_row).collect()
}

#[test]
fn error_scores_match_their_definition() {
    let views = views();
    for subject in all() {
        let mut table = Table::new(&format!("error scores, {}", subject.name()));
        for score in [
            ErrorScore {
                power: 4.0,
                edge: 0.25,
                footprint: 0.75,
                view_power: 0.4,
                ..ErrorScore::default()
            },
            ErrorScore { power: 2.0, ..ErrorScore::default() },
            ErrorScore { power: 1.5, ..ErrorScore::default() },
            ErrorScore { edge: 1.5, ..ErrorScore::default() },
            ErrorScore { footprint: 1.0, ..ErrorScore::default() },
            ErrorScore { view_power: 0.5, ..ErrorScore::default() },
            ErrorScore { map: ErrorMap::L1, ..ErrorScore::default() },
            ErrorScore { map: ErrorMap::Dssim, edge: 1.5, ..ErrorScore::default() },
        ] {
            let wanted = [Signal::ErrorScore];
            let needs = Needs { signals: wanted.into(), error_score: score, ..Needs::default() };
            let (_, columns) = collect_with(&subject, &views, &wanted, needs);
            let mut expected = vec![0.0; views.model.len()];
            for (camera, target) in views.cameras.iter().zip(&views.targets) {
                let view = View { camera, background: BACKGROUND.map(f64::from), sh_degree: 2 };
                for (sum, part) in
                    expected.iter_mut().zip(scores(&views.model, view, target, &score))
                {
                    *sum += part;
                }
            }
            let error = relative_error(&columns[0], &expected);
            let case = format!("{score:?}");
            // Raising the error to a power multiplies its relative error by the exponent.
            let tolerance = tolerance(&subject) * f64::from(score.power);
            table.check(&case, "ErrorScore", error, tolerance);
        }
        table.finish();
    }
}

#[test]
fn the_largest_weight_covers_the_previous_epoch() {
    let views = views();
    for subject in all() {
        let (mut backend, columns) = collect(&subject, &views, &[Signal::WeightMax], 0.0);
        let mut now = |begins_epoch: bool| {
            if begins_epoch {
                backend.begin_epoch();
            }
            let signals = backend.take_signals(SignalSet::from([Signal::WeightMax]));
            let signals = signals.expect("signals can be taken");
            signals.get(Signal::WeightMax).expect("a requested signal").to_vec()
        };
        assert!(columns[0].iter().any(|&w| w > 0.1));
        assert!(now(true) == columns[0], "the previous epoch is ignored");
        assert!(now(true).iter().all(|&w| w.to_bits() == 0), "an earlier epoch still counts");
    }
}

/// Signals and parameters agree bit for bit, for all kinds of storage, even for rows that an edit has moved.
#[test]
fn attribute_signals_equal_the_parameters() {
    let views = views();
    let wanted = SignalSet::from([
        Signal::Age,
        Signal::Position,
        Signal::LogScale,
        Signal::Orientation,
        Signal::Colour,
    ]);
    let native = storages().map(|storage| (Subject::NATIVE, storage));
    let gpus = devices().iter().cloned().map(|gpu| (Subject::Gpu(gpu), Storage::default()));
    for (subject, storage) in native.into_iter().chain(gpus) {
        let needs = Needs { signals: wanted, ..Needs::default() };
        let setup = Setup { needs, storage, ..Setup::default() };
        let mut backend = make_with(&subject, &views.model, setup);
        let (camera, target) = (&views.cameras[0], &views.targets[0]);
        backend.train_step(&step_input(1, camera, target, 2)).expect("a small image is rendered");
        let mut plan = EditPlan::new(views.model.len(), backend.budget());
        plan.prune_all([0, 3]);
        backend.apply(&plan.compile(), 1, 1).expect("a plan is applied");
        let signals = backend.take_signals(wanted).expect("signals can be taken");
        let column = |signal| signals.get(signal).expect("a declared signal");
        let model = backend.download().expect("a model");
        let case = format!("{}, {storage:?}", subject.name());
        assert_eq!(model.len(), views.model.len() - 2);
        assert!(column(Signal::Position) == model.means.as_flattened(), "positions: {case}");
        assert!(column(Signal::LogScale) == model.log_scales.as_flattened(), "scales: {case}");
        assert!(column(Signal::Orientation) == model.quats.as_flattened(), "orientations: {case}");
        let dc = (0..model.len()).flat_map(|row| model.sh_of(row)[..3].to_vec());
        assert!(dc.map(dc_to_rgb).eq(column(Signal::Colour).iter().copied()), "colours: {case}");
        assert!(column(Signal::Age).iter().all(|&age| age > 0.5), "ages: {case}");
        backend.give_back(signals);
    }
}

/// Signals are returned in the buffer of gradient sums. Neither the return of the buffer nor the number of columns may
/// affect later steps or images.
#[test]
fn reading_signals_does_not_affect_later_steps_or_images() {
    let views = views();
    let declared = SignalSet::from([Signal::ScreenGradient, Signal::WeightMax]);
    let present = declared.with(Signal::Age).with(Signal::ScaleMax);
    // More columns than the buffer of a step has room for.
    let many = SignalSet::from(Signal::ALL);
    let run = |subject: &Subject, read: Option<SignalSet>, gives_back: bool| {
        let needs = Needs { signals: declared, ..Needs::default() };
        let setup = Setup { needs, ..Setup::default() };
        let mut backend = make_with(subject, &views.model, setup);
        let mut image = None;
        for step in 1..=4 {
            let (camera, target) = (&views.cameras[0], &views.targets[0]);
            let input = StepInput { background: BACKGROUND, ..step_input(step, camera, target, 2) };
            backend.train_step(&input).expect("a small image is rendered");
            let taken = read.map(|wanted| backend.take_signals(wanted).expect("signals"));
            image = Some(backend.render(camera, BACKGROUND, 2).expect("a small image"));
            if let Some(signals) = taken.filter(|_| gives_back) {
                backend.give_back(signals);
            }
        }
        let signals = backend.take_signals(declared).expect("signals");
        let column = |signal| signals.get(signal).expect("a declared signal").to_vec();
        let columns = [column(Signal::ScreenGradient), column(Signal::WeightMax)];
        (backend.download().expect("a model"), image.expect("four").rgb, columns)
    };
    for subject in repeatable() {
        let expected = run(&subject, None, false);
        assert!(expected.2.iter().all(|column| column.iter().any(|&x| x > 0.0)));
        for wanted in [declared, present, many] {
            for gives_back in [false, true] {
                let found = run(&subject, Some(wanted), gives_back);
                assert!(found == expected, "{}: {wanted:?}, {gives_back}", subject.name());
            }
        }
    }
}
