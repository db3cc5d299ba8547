//! What a run takes, buffer by buffer, for any size of it, before anything of it is allocated. A run, the
//! solver for `--memory` and `densify plan` read this ledger, so they cannot disagree.

use densify_policies::plan::bytes_per_row;
use densify_policies::policy::Needs;
use glam::DVec3;

use super::{DECODERS, Inputs};
use crate::companion::CompanionSize;
use crate::measuring::Measuring;
use crate::memory::RunSize;
use crate::start::{first_bytes, reading_bytes};
use densify_core::gaussians::sh_coefficients;
use densify_core::memory::{Ledger, Section};
use densify_core::pieces::ROWS_AT_A_TIME;
use densify_data::dataset::images::ImageDemand;
use densify_data::dataset::{Dataset, View};
use densify_data::models::{PLY, Shape};
use densify_render::{KeptPhotographs, MomentStorage, Setup, Shortcuts, Storage};
use densify_train::exposure::Exposures;
use densify_train::metrics::{geometry, scratch_bytes};
use densify_train::trainer::AutoChoices;

/// What the program takes for itself: its code as far as it runs, and the stacks of its threads.
/// Measured at 10 to 13 MiB, and at about 14 MiB in builds for tests (profile `dev`).
const PROGRAM: u64 = 16 << 20;
/// A program that takes more, such as one with a driver in it, is taken at what it has, in these
/// steps: what is promised should not change from call to call.
const PROGRAM_STEP: u64 = 8 << 20;
/// What the system's allocator keeps between two uses of a piece. Measured at up to 5 MiB.
const KEPT: u64 = 6 << 20;
/// What a policy makes of its signals for each row before it plans: means, orders, sums of weights
/// and draws. Those that make more of auxiliary views' columns have these counted twice. Bringing rows into
/// their order takes at most as much, when this is free again.
const PLANNING: u64 = 20;
/// What a thread of either pool takes: what it touches of its stack and keeps of its buffers. Measured at
/// 44 to 52 KiB for both together, from 64 to 256 threads.
const THREAD: u64 = 64 << 10;
/// What is promised holds for any number of threads up to this, so that it does not depend on them.
pub(super) const THREADS: usize = 64;
/// What the exposures take at most as a copy and as text, for each of their bytes.
const EXPOSURE_TEXT: u64 = 1 + 4;
/// A point with its colour.
const POINT: u64 = (size_of::<DVec3>() + 3) as u64;

impl Inputs<'_> {
    /// How the backend is made for a size.
    pub(crate) fn backend_options(&self, setting: &RunSize, needs: Needs) -> Setup {
        Setup {
            frozen: self.frozen_rows(),
            near: (self.spec.start.near.0 * self.dataset.extent()) as f32,
            tile_cap: Some(setting.tile_cap),
            record_cap: self.record_cap(setting),
            threads: self.spec.device.threads.map(|threads| threads.0 as usize),
            largest_image: self.dataset.largest_image(),
            photographs: self.kept_photographs(setting),
            storage: self.knobs.storage,
            shortcuts: self.knobs.shortcuts,
            needs,
            exposures: self.exposure.is_on,
            ..Setup::new(setting.rows)
        }
    }

    /// Gradient records for two pairs in five, where pairs are counted; else for all.
    fn record_cap(&self, setting: &RunSize) -> usize {
        match self.knobs.pairs_per_row {
            Some(_) => (setting.tile_cap / 5 * 2).max(1),
            None => usize::MAX,
        }
    }

    /// What of the training images stays on a GPU.
    fn kept_photographs(&self, setting: &RunSize) -> KeptPhotographs {
        let train = &self.dataset.train;
        let with_masks = train.iter().any(|view| view.source.is_masked());
        let one = KeptPhotographs::bytes(self.dataset.largest_image(), with_masks);
        let count = setting.images_on_gpu / one.iter().sum::<u64>().max(1);
        let count = usize::try_from(count).unwrap_or(usize::MAX);
        KeptPhotographs { count: count.min(train.len()), with_masks }
    }

    /// Everything that a run takes with these needs: the one function that tells the bytes of a size,
    /// to which the solver finds the largest size.
    pub(crate) fn ledger(&self, setting: &RunSize, needs: &Needs) -> Ledger {
        let threads = self.threads().max(THREADS);
        let degree = setting.sh_degree;
        let options = self.backend_options(setting, needs.clone());
        let mut ledger = self.device.promise(degree, &options, threads);
        let [train, test] = self.images;
        let held = train.held(setting.image_cache);
        ledger.add_to(Section::Images, "decoded training views", held);
        ledger.add_to(Section::Images, "decoding", train.decoding(DECODERS));
        if needs.least_resolution.is_some() {
            ledger.add_to(Section::Images, "a view at a lower resolution", train.largest);
        }
        let budget = setting.rows as u64;
        let float = size_of::<f32>() as u64;
        let row = float * (11 + 3 * sh_coefficients(degree) as u64);
        // Values and moments of the exposures; the same again, as text, in a checkpoint.
        let exposures =
            if self.exposure.is_on { Exposures::bytes(self.dataset.train.len()) } else { 0 };
        if exposures > 0 {
            ledger.add_to(Section::Model, "exposures of the views", exposures);
        }
        if self.track_bytes > 0 {
            let bytes = self.track_bytes + train.held(0) + train.decoding(1);
            ledger.add_to(Section::Before, "colours of tracks", bytes);
        }
        if let Some(model) = self.init_model {
            let bytes = first_bytes(model, self, setting, threads);
            ledger.add_to(Section::Before, "the model it starts from", bytes);
        }
        if let Some(model) = self.frozen {
            ledger.add_to(Section::Before, "the frozen model", reading_bytes(model));
        }
        let mut pass = |what: &str, bytes| ledger.add_to(Section::Passing, what, bytes);
        // Points, their order, neighbours in f64, and the rows before the backend has them.
        let first = (self.initial_rows(setting.rows) + self.frozen_rows()) as u64;
        let points =
            self.spec.start.init_points.map_or(self.dataset.points.len(), |points| points.0) as u64;
        pass("first rows", points.max(first) * (POINT + 16) + first * (row + 96));
        pass("a policy's event", self.event_bytes(setting, needs));
        // So many rows, as much again because allocators keep some freed arrays for a while, and what the
        // writer holds.
        let piece = budget.min(ROWS_AT_A_TIME as u64);
        let held = PLY.held_bytes(Shape { rows: setting.rows, sh_degree: degree });
        pass("export of the model, checkpoint", 2 * piece * row + held + EXPOSURE_TEXT * exposures);
        if let Some(companion) = self.companion {
            let size = CompanionSize {
                budget,
                device: &self.device,
                largest_image: self.dataset.largest_image(),
                photograph: train.held(0).max(test.held(0))
                    + train.decoding(1).max(test.decoding(1)),
                views: self.dataset.train.len() + self.dataset.test.len(),
                threads,
            };
            (companion.reserve)(&size, &mut ledger);
        }
        let mut pass = |what: &str, bytes| ledger.add_to(Section::Passing, what, bytes);
        let measures_test = !self.dataset.test.is_empty();
        if measures_test || self.required != AutoChoices::default() || self.init_model.is_some() {
            let (width, height) = self.dataset.largest_image();
            // One more of its colours, with the exposure that fits best.
            let planes = if self.exposure.is_on { 8 } else { 5 };
            let rendering = u64::from(width) * u64::from(height) * planes * float;
            let of = |images: &ImageDemand| images.held(0) + images.decoding(1);
            let tested = if measures_test { of(&test) } else { 0 };
            let image = tested.max(if self.init_model.is_some() { of(&train) } else { 0 });
            // While it is asked which rows are missed: their order, and their opacities twice or, when
            // that is done, a plan.
            let row = float + (2 * float).max(bytes_per_row(&Needs::default()) as u64);
            let asked = if self.required.rows { budget * row } else { 0 };
            pass("measuring a view", rendering + image + scratch_bytes(width, threads) + asked);
        }
        let process = self.process_bytes();
        if let Some(beyond) = self.peak.and_then(|peak| peak.checked_sub(process)) {
            ledger.add_to(Section::Before, "loading the scene", beyond);
        }
        ledger.add_to(Section::Process, "program and dataset", process);
        let stacks = threads as u64 * THREAD;
        ledger.add_to(Section::Process, format!("up to {threads} threads"), stacks);
        let Some(measuring) = self.measuring(setting, threads) else { return ledger };
        let counted = measuring.counted(&ledger, setting.rows, degree);
        // It does not lower the number of rows: where memory is given and too little, it is left out.
        match self.memory() {
            Some(memory) if self.device.limited_bytes(&counted) > memory => ledger,
            _ => counted,
        }
    }

    /// How the model is measured at the end, where views are held out and the surface is known.
    pub(crate) fn measuring(&self, setting: &RunSize, threads: usize) -> Option<Measuring> {
        let surface = self.dataset.surface_bytes.filter(|_| !self.dataset.test.is_empty())?;
        let options = Setup {
            photographs: KeptPhotographs::default(),
            // Nothing is trained, so moments may be small.
            storage: Storage { moments: MomentStorage::Both8, ..Storage::default() },
            shortcuts: Shortcuts::default(),
            ..self.backend_options(setting, geometry::needs())
        };
        let (device, views) = (self.device.clone(), self.dataset.test.len());
        Some(Measuring { device, options, threads, surface, views })
    }

    /// Signals on the host, the plan, and what the policy makes of the former.
    fn event_bytes(&self, setting: &RunSize, needs: &Needs) -> u64 {
        let float = size_of::<f32>() as u64;
        let candidate = size_of::<densify_policies::policy::Candidate>() as u64;
        let seed = size_of::<densify_policies::plan::Seed>() as u64;
        // The native backend has room for them.
        let signals = self.device.columns_on_host(needs.signals.width()) as u64;
        // One auxiliary view's columns, and as many that a policy makes of them; all views' points.
        let aux = needs.aux.as_ref();
        let columns = aux.map_or(0, |request| 2 * request.columns.len()) as u64;
        let points = aux.map_or(0, |request| u64::from(request.points));
        // A point is kept by the policy, becomes a seed, and is compiled.
        let plan = bytes_per_row(needs) as u64;
        setting.rows as u64 * ((signals + columns) * float + plan + PLANNING)
            + points * self.dataset.train.len() as u64 * (candidate + 3 * seed)
    }

    /// The program and the dataset, but for what the ledger has besides. A number that does not
    /// depend on what else the process has done, where it takes no more than expected.
    fn process_bytes(&self) -> u64 {
        let Dataset { train, test, points, .. } = &self.dataset;
        let views = train.iter().chain(test);
        let rendered = |view: &View| view.source.rendered.as_ref().map_or(0, |image| image.bytes());
        // A view's name and path; it is there once more for its images.
        let view = |view: &View| (3 * size_of::<View>() + 512) as u64 + rendered(view);
        let expected = PROGRAM + views.map(view).sum::<u64>() + points.len() as u64 * POINT;
        let program = match self.resident {
            Some(resident) if resident > expected => resident.next_multiple_of(PROGRAM_STEP),
            _ => expected,
        };
        program + KEPT
    }

    /// Bytes of all training images decoded.
    pub(super) fn all_images(&self) -> u64 {
        self.images[0].all
    }
}
