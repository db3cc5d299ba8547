//! The memory of a run of any size, buffer by buffer, before anything is allocated. Runs, the solver for `--memory` and
//! `densify plan` use the same ledger, so they cannot disagree. It is a pure function of inputs, choices and size.

use densify_policies::plan::bytes_per_row;
use densify_policies::policy::Needs;
use glam::DVec3;

use super::case::{Case, DECODERS};
use super::fit::RunSize;
use super::geometry_measurement::GeometryMeasurement;
use super::models::{add_first_model, reading_bytes};
use crate::companion::CompanionSize;
use densify_core::antialiasing::Antialiasing;
use densify_core::gaussians::sh_coefficients;
use densify_core::memory::{Ledger, Section};
use densify_core::pieces::ROWS_AT_A_TIME;
use densify_data::dataset::images::ImageDemand;
use densify_data::dataset::{Dataset, DepthSource, View};
use densify_data::models::{Coordinates, Frame, PLY, Shape};
use densify_render::{KeptPhotographs, MomentStorage, Setup, Shortcuts, Storage};
use densify_train::exposure::Exposures;
use densify_train::metrics::{geometry, scratch_bytes};
use densify_train::poses::Poses;
use densify_train::trainer::AutoChoices;
use densify_train::vignette::Vignettes;

/// Memory of the program itself `[bytes]`: the code pages in use, and the stacks of its threads. Measured at 15 to 17
/// MiB, and at up to 20 MiB in builds for tests (profile `dev`): it varies with what the system has mapped already.
const PROGRAM: u64 = 20 << 20;
/// If the process takes more than expected, for example because of a driver, its actual memory counts, rounded up to a
/// multiple of this number so that the ledger does not change from call to call `[bytes]`. Calls of one build differ by
/// up to 0.7 MiB, builds by up to 5 MiB, from 15 to 20: with a smaller step, more builds would have calls on both sides
/// of a multiple.
const PROGRAM_STEP: u64 = 8 << 20;
/// Memory that the system's allocator keeps between two uses `[bytes]`. Measured at up to 5 MiB.
const ALLOCATOR_RESERVE: u64 = 6 << 20;
/// Bytes per row of the values that a policy derives from its signals before it plans: means, orders, sums of weights
/// and random numbers. Columns of auxiliary views are counted twice, because policies derive as many values from them.
/// Sorting rows afterwards takes no more than these bytes, which are free again by then.
const PLANNING_BYTES: u64 = 20;
/// Bytes per thread of both thread pools together: the used part of its stack, and the buffers that it keeps. Measured
/// at 44 to 52 KiB with 64 to 256 threads.
const THREAD_BYTES: u64 = 64 << 10;
/// The ledger assumes at least this many threads, so that it is the same for all smaller numbers.
const MIN_THREADS: usize = 64;
/// Maximum bytes of a copy of the exposures, vignettes and poses and of their text, per byte of them.
const LEARNED_TEXT: u64 = 1 + 4;
/// Bytes of a point with its colour.
const POINT_BYTES: u64 = (size_of::<DVec3>() + 3) as u64;

impl Case<'_> {
    /// The setup of the backend for a size.
    pub(crate) fn backend_setup(&self, size: &RunSize, needs: Needs) -> Setup {
        Setup {
            budget: self.budget(size.rows),
            near: self.choices.near.distance(),
            tile_cap: Some(size.tile_cap),
            record_cap: self.record_cap(size),
            threads: self.spec.device.threads.map(|threads| threads.0 as usize),
            largest_image: self.inputs.dataset.largest_image(),
            photographs: self.kept_photographs(size),
            storage: self.choices.knobs.storage,
            shortcuts: self.choices.knobs.shortcuts,
            needs,
            exposures: self.choices.exposure.is_on,
            poses: self.choices.poses.is_on,
            vignettes: self.choices.vignette.is_on,
            depth: self.has_depth(),
            ..Setup::default()
        }
    }

    /// True if depth may be in the loss: if it is given, or if distortion has a weight.
    pub(super) fn has_depth(&self) -> bool {
        self.inputs.dataset.depth.is_some() || self.spec.depth.distortion() > 0.0
    }

    /// The maximum number of gradient records: two for every five pairs if the knob `pairs_per_row` is set, else
    /// unlimited.
    fn record_cap(&self, size: &RunSize) -> usize {
        match self.choices.knobs.pairs_per_row {
            Some(_) => (size.tile_cap / 5 * 2).max(1),
            None => usize::MAX,
        }
    }

    /// The training images that stay on a GPU.
    fn kept_photographs(&self, size: &RunSize) -> KeptPhotographs {
        let train = &self.inputs.dataset.train;
        let with_masks = train.iter().any(|view| view.source.is_masked());
        let one = KeptPhotographs::bytes(self.inputs.dataset.largest_image(), with_masks);
        let count = size.images_on_gpu / one.iter().sum::<u64>().max(1);
        let count = usize::try_from(count).unwrap_or(usize::MAX);
        KeptPhotographs { count: count.min(train.len()), with_masks }
    }

    /// Adds the values and moments of the exposures, vignettes and poses, and returns their bytes; the same again, as text, is
    /// in a checkpoint.
    fn add_learned_of_views(&self, ledger: &mut Ledger) -> u64 {
        let (choices, views) = (&self.choices, self.inputs.dataset.train.len());
        let mut sum = 0;
        for (is_on, what, bytes) in [
            (choices.exposure.is_on, "exposures of the views", Exposures::bytes(views)),
            (choices.vignette.is_on, "vignettes of the cameras", Vignettes::bytes(views)),
            (choices.poses.is_on, "poses of the views", Poses::bytes(views)),
        ] {
            if is_on {
                ledger.add_to(Section::Model, what, bytes);
                sum += bytes;
            }
        }
        sum
    }

    /// All memory of a run with these needs. The solver finds the largest size with this function.
    pub(crate) fn ledger(&self, size: &RunSize, needs: &Needs) -> Ledger {
        let threads = self.choices.threads.max(MIN_THREADS);
        let degree = size.sh_degree;
        let setup = self.backend_setup(size, needs.clone());
        let mut ledger = self.inputs.device.memory_plan(degree, &setup, threads);
        let [train, test] = self.inputs.images;
        let held = train.held(size.image_cache);
        let has_depth = self.inputs.dataset.depth.is_some();
        let images =
            if has_depth { "decoded training views with depth" } else { "decoded training views" };
        ledger.add_to(Section::Images, images, held);
        ledger.add_to(Section::Images, "decoding", train.decoding(DECODERS));
        if needs.least_resolution.is_some() {
            ledger.add_to(Section::Images, "a view at a lower resolution", train.largest);
        }
        let budget = size.rows as u64;
        let float = size_of::<f32>() as u64;
        let row = float * (11 + 3 * sh_coefficients(degree) as u64);
        let learned = self.add_learned_of_views(&mut ledger);
        if self.inputs.track_bytes > 0 {
            let bytes = self.inputs.track_bytes + train.held(0) + train.decoding(1);
            ledger.add_to(Section::Before, "colours of tracks", bytes);
        }
        if let Some(model) = self.inputs.init_model {
            add_first_model(&mut ledger, model, self, size, threads);
        }
        if let Some(model) = self.inputs.frozen_model {
            ledger.add_to(Section::Before, "the frozen model", reading_bytes(model));
        }
        let mut pass = |what: &str, bytes| ledger.add_to(Section::Passing, what, bytes);
        // Points, their order, neighbours in f64, and the first rows before they are copied to the backend.
        let first = self.rows_for(self.initial_rows(size.rows)) as u64;
        let points =
            self.spec.start.init_points.map_or(self.inputs.dataset.points.len(), |points| points.0)
                as u64;
        pass("first rows", points.max(first) * (POINT_BYTES + 16) + first * (row + 96));
        pass("a policy's event", self.event_bytes(size, needs));
        // A piece of rows, the same again because allocators keep some freed arrays for a while, and the buffers of the
        // writer.
        let piece = budget.min(ROWS_AT_A_TIME as u64);
        let held = PLY.held_bytes(Shape {
            rows: size.rows,
            sh_degree: degree,
            antialiasing: Antialiasing::None,
            frame: Frame {
                is_double: self.spec.output.coordinates == Coordinates::Double,
                ..Frame::WORLD
            },
        });
        pass("export of the model, checkpoint", 2 * piece * row + held + LEARNED_TEXT * learned);
        if let Some(companion) = self.inputs.companion {
            let sizes = CompanionSize {
                budget,
                device: &self.inputs.device,
                largest_image: self.inputs.dataset.largest_image(),
                photograph: train.held(0).max(test.held(0))
                    + train.decoding(1).max(test.decoding(1)),
                views: self.inputs.dataset.train.len() + self.inputs.dataset.test.len(),
                threads,
            };
            (companion.reserve)(&sizes, &mut ledger);
        }
        let mut pass = |what: &str, bytes| ledger.add_to(Section::Passing, what, bytes);
        let measures_test = !self.inputs.dataset.test.is_empty();
        if measures_test
            || self.choices.automatic != AutoChoices::default()
            || self.inputs.init_model.is_some()
        {
            let (width, height) = self.inputs.dataset.largest_image();
            // Exposures need another copy of the colours, transformed by the exposure that fits best.
            let planes = if self.choices.exposure.is_on { 8 } else { 5 };
            let rendering = u64::from(width) * u64::from(height) * planes * float;
            let one_image = |images: &ImageDemand| images.held(0) + images.decoding(1);
            let tested = if measures_test { one_image(&test) } else { 0 };
            let image =
                tested.max(if self.inputs.init_model.is_some() { one_image(&train) } else { 0 });
            // Finding the least important rows takes the order of all rows, and in addition first two copies of their
            // opacities, then a plan.
            let row = float + (2 * float).max(bytes_per_row(&Needs::default()) as u64);
            let removal = if self.choices.automatic.rows { budget * row } else { 0 };
            // A copy of the exact means, while the model is measured with its means rounded as in the saved file.
            let rounds_means = self.spec.output.coordinates == Coordinates::World
                && self.inputs.dataset.normalisation.is_remote();
            let means = if rounds_means { 3 * float * budget } else { 0 };
            let other = scratch_bytes(width, threads) + removal + means;
            pass("measuring a view", rendering + image + other);
        }
        let process = self.process_bytes();
        if let Some(excess) = self.inputs.peak.and_then(|peak| peak.checked_sub(process)) {
            ledger.add_to(Section::Before, "loading the scene", excess);
        }
        ledger.add_to(Section::Process, "program and dataset", process);
        let stacks = threads as u64 * THREAD_BYTES;
        ledger.add_to(Section::Process, format!("up to {threads} threads"), stacks);
        let Some(measurement) = self.geometry_measurement(size, threads) else { return ledger };
        let counted = measurement.added_to(&ledger, size.rows, degree);
        // The measurement must not lower the number of rows: if the memory limit is too small, the measurement is
        // skipped.
        match self.memory() {
            Some(memory) if self.inputs.device.limited_bytes(&counted) > memory => ledger,
            _ => counted,
        }
    }

    /// The measurement at the end, if views are held out and the surface is known.
    pub(crate) fn geometry_measurement(
        &self,
        size: &RunSize,
        threads: usize,
    ) -> Option<GeometryMeasurement> {
        let surface =
            self.inputs.dataset.surface_bytes.filter(|_| !self.inputs.dataset.test.is_empty())?;
        let setup = Setup {
            photographs: KeptPhotographs::default(),
            // Nothing is trained, so moments may be small.
            storage: Storage { moments: MomentStorage::Both8, ..Storage::default() },
            shortcuts: Shortcuts::default(),
            depth: false,
            ..self.backend_setup(size, geometry::needs())
        };
        let (device, views) = (self.inputs.device.clone(), self.inputs.dataset.test.len());
        Some(GeometryMeasurement { device, setup, threads, surface, views })
    }

    /// Bytes of signals on the host, of the plan, and of values that the policy derives from the signals.
    fn event_bytes(&self, size: &RunSize, needs: &Needs) -> u64 {
        let float = size_of::<f32>() as u64;
        let candidate = size_of::<densify_policies::policy::Candidate>() as u64;
        let seed = size_of::<densify_policies::plan::Seed>() as u64;
        // With the native backend, the policy reads the backend's own arrays of signals.
        let signals = self.inputs.device.columns_on_host(needs.signals.width()) as u64;
        // The columns of one auxiliary view, and as many columns that a policy derives from these; the points of all
        // views.
        let aux = needs.aux.as_ref();
        let columns = aux.map_or(0, |request| 2 * request.columns.len()) as u64;
        let points = aux.map_or(0, |request| u64::from(request.points));
        // The policy keeps a point, makes a seed of it, and compiles the seed.
        let plan = bytes_per_row(needs) as u64;
        let own = needs.scratch_bytes as u64;
        let points = points * self.inputs.dataset.train.len() as u64;
        let candidates = needs.candidates.as_ref().map_or(0, |request| request.capacity as u64);
        let copied = if needs.copies_points { candidates.saturating_add(points) } else { 0 };
        let per_row = (signals + columns) * float + plan + PLANNING_BYTES + own;
        (size.rows as u64)
            .saturating_mul(per_row)
            .saturating_add(points * (candidate + 3 * seed))
            .saturating_add(copied.saturating_mul(candidate))
    }

    /// Bytes of the program and the dataset that have no other line in the ledger. The number does not depend on what
    /// else the process has done, unless it takes more than expected.
    fn process_bytes(&self) -> u64 {
        let Dataset { train, test, points, .. } = &self.inputs.dataset;
        let views = train.iter().chain(test);
        let rendered = |view: &View| view.source.rendered.as_ref().map_or(0, |image| image.bytes());
        // A view's name and path, in the dataset and again for its images.
        let depth = |view: &View| {
            let depth = view.source.depth.as_ref();
            depth.map_or(0, |depth| 3 * depth.held_bytes() + depth.pixel_bytes())
        };
        let view = |view: &View| {
            // A view's depth is counted with the depth, so that runs without depth need no more memory than before it
            // existed.
            let bare = size_of::<View>() - size_of::<Option<Box<DepthSource>>>();
            (3 * bare + 464) as u64 + rendered(view) + depth(view)
        };
        let shared = train.iter().find_map(|view| view.source.depth.as_ref());
        let shared = shared.map_or(0, |depth| depth.shared_bytes());
        let expected =
            PROGRAM + views.map(view).sum::<u64>() + points.len() as u64 * POINT_BYTES + shared;
        let program = match self.inputs.resident {
            Some(resident) if resident > expected => resident.next_multiple_of(PROGRAM_STEP),
            _ => expected,
        };
        program + ALLOCATOR_RESERVE
    }

    /// Bytes of all training images when decoded.
    pub(super) fn all_image_bytes(&self) -> u64 {
        self.inputs.images[0].all
    }
}
