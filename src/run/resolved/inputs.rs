//! The inputs of a run, opened once: device, dataset, and the sizes of the models that it starts from.

use crate::companion::Companion;
use crate::failure::{Failure, OptionProblem, notes};
use crate::host::Host;
use crate::observer::{Observer, say_notes};
use crate::spec::knobs::Knobs;
use crate::spec::{AbsolutePath, InitChoice, RunSpec, StartSpec};
use densify_data::dataset::images::ImageDemand;
use densify_data::dataset::{Dataset, ReportedExposures, TrackReading, Tracks, View};
use densify_data::track_colours::vignettes;
use densify_data::track_colours::{self, MIN_TRACKS, TrackColours};
use densify_data::track_poses;
use densify_render::{Accumulation, BackendKind, Device};
use densify_train::init::usable_points;

use super::config::ModelSize;
use super::models::{file_of, size_of_model};
use super::vignette::VignetteEvidence;

/// Everything that a run reads and runs on.
#[derive(Clone)]
pub(crate) struct Inputs {
    pub(crate) device: Device,
    /// The dataset without its tracks, which are part of the [`Evidence`].
    pub(crate) dataset: Dataset,
    /// The memory that the images of the training and of the test views take.
    pub(crate) images: [ImageDemand; 2],
    /// File and size of the model of `--init`, if there is one.
    pub(super) init_file: Option<AbsolutePath>,
    pub(crate) init_model: Option<ModelSize>,
    /// File and size of the model of `--freeze`, if there is one.
    pub(crate) frozen_file: Option<AbsolutePath>,
    pub(crate) frozen_model: Option<ModelSize>,
    /// Number of Gaussians of a run that starts from all points of the dataset.
    pub(super) usable_points: usize,
    /// Bytes of the tracks and their colours while these are read, not counting the images; 0 if no automatic choice
    /// uses the tracks.
    pub(super) track_bytes: u64,
    /// Resident memory with the dataset and the device's driver, if it is known `[bytes]`.
    pub(super) resident: Option<u64>,
    /// Peak resident memory before the driver compiled its kernels, if it is known `[bytes]`.
    pub(super) peak: Option<u64>,
    pub(super) companion: Option<Companion>,
}

/// Evidence for automatic choices. It is freed before training.
#[derive(Default)]
pub(super) struct Evidence {
    pub(super) tracks: Tracks,
    /// The colours of the tracks; `None` if there are too few tracks, or colours were not read.
    pub(super) colours: Option<TrackColours>,
    /// Exposures in EXIF.
    pub(super) reported: ReportedExposures,
    /// Vignettes of the cameras.
    pub(super) vignettes: VignetteEvidence,
}

/// The evidence to read in addition to the dataset, and the sizes of models if they are known.
#[derive(Default)]
pub(super) struct Reading {
    /// Sizes of the models of `--init` and `--freeze`; `None`: their files are read.
    pub(super) models: Option<[Option<ModelSize>; 2]>,
    /// Something is decided by the colours of the tracks.
    pub(super) by_colours: bool,
    /// Something is decided by where photographs show the points of the tracks.
    pub(super) by_directions: bool,
    /// Read the colours of the tracks, if something is decided by them; otherwise only their memory is counted.
    pub(super) colours: bool,
    /// Read the exposures in EXIF.
    pub(super) exif: bool,
    /// Measure the vignettes of the cameras.
    pub(super) vignettes: bool,
    /// The decision about depth that an earlier session of the run has taken.
    pub(super) depth: Option<bool>,
    /// Resident memory that is not counted `[bytes]`, so that a resumed run is not refused because its process takes a
    /// little more than the process that started the run.
    pub(super) tolerance: u64,
}

impl Reading {
    /// What to read of the tracks of the reconstruction.
    fn tracks(&self) -> TrackReading {
        match (self.by_directions, self.by_colours) {
            (true, _) => TrackReading::Directions,
            (false, true) => TrackReading::Views,
            (false, false) => TrackReading::Nothing,
        }
    }
}

impl Inputs {
    /// Loads the dataset, and the evidence that `reading` names.
    pub(super) fn open(
        spec: &RunSpec,
        device: Device,
        reading: &Reading,
        host: Host<'_>,
    ) -> Result<(Self, Evidence), Failure> {
        let observer = host.observer;
        let scene = spec.scene()?;
        let mut dataset =
            Dataset::load(scene, &spec.load_options(reading.tracks(), reading.depth))?;
        say_notes(observer, &dataset.notes);
        observer.say(format_args!("scene    {}: {}", scene.display(), dataset.describe()));
        if let Some(depth) = &dataset.depth {
            observer.say(format_args!("depth    {}", depth.describe()));
        }
        let usable_points = usable_points(&dataset.points);
        let StartSpec { init, freeze, .. } = &spec.start;
        let init = match init {
            Some(InitChoice::Model(path)) => Some(path),
            Some(InitChoice::Points | InitChoice::Random) | None => None,
        };
        let [known_init, known_frozen] =
            reading.models.map_or([None; 2], |models| models.map(Some));
        let (init_file, init_model) = start_model("init", init, known_init, observer)?;
        let (frozen_file, frozen_model) =
            start_model("freeze", freeze.as_ref(), known_frozen, observer)?;
        // Tracks have a separate line in the ledger, and are freed before training.
        let uncounted = dataset.tracks.bytes() + reading.tolerance;
        let resident = (host.process.resident)().map(|now| now.saturating_sub(uncounted));
        let peak = (host.process.peak)();
        let tracks = std::mem::take(&mut dataset.tracks);
        let has_colours = reading.by_colours && reading.colours && tracks.count() >= MIN_TRACKS;
        let mut colours =
            has_colours.then(|| TrackColours::read(&tracks, &dataset.train)).transpose()?;
        let mut track_bytes = tracks.bytes();
        if reading.by_colours {
            track_bytes += track_colours::bytes(&tracks);
        }
        if reading.by_directions {
            track_bytes += track_poses::bytes(&tracks);
        }
        let mut of_vignettes = VignetteEvidence::default();
        if reading.vignettes {
            track_bytes += vignettes::bytes(&tracks);
            of_vignettes = VignetteEvidence::measure(&tracks, colours.as_mut(), &dataset.train);
        }
        let reported = reading.exif.then(|| ReportedExposures::read(&dataset.train));
        let reported = reported.unwrap_or_default();
        let inputs = Self {
            images: image_demand(&dataset),
            device,
            dataset,
            init_file,
            init_model,
            frozen_file,
            frozen_model,
            usable_points,
            track_bytes,
            resident,
            peak,
            companion: host.companion,
        };
        Ok((inputs, Evidence { tracks, colours, reported, vignettes: of_vignettes }))
    }

    /// The same inputs with the photographs at the resolution of `spec`.
    pub(super) fn at_resolution_of(&self, spec: &RunSpec) -> Result<Self, Failure> {
        let dataset = Dataset::load(
            spec.scene()?,
            &spec.load_options(TrackReading::Nothing, Some(self.dataset.depth.is_some())),
        )?;
        Ok(Self { images: image_demand(&dataset), dataset, ..self.clone() })
    }
}

/// The memory that the images of the training and of the test views take.
fn image_demand(dataset: &Dataset) -> [ImageDemand; 2] {
    let demand = |views: &[View]| ImageDemand::total(views.iter().map(|view| &view.source));
    [demand(&dataset.train), demand(&dataset.test)]
}

/// The file of the model that an option names, and its size, which is read from the file unless it is known.
fn start_model(
    option: &'static str,
    named: Option<&AbsolutePath>,
    known: Option<Option<ModelSize>>,
    observer: &dyn Observer,
) -> Result<(Option<AbsolutePath>, Option<ModelSize>), Failure> {
    match (named, known) {
        (_, Some(size)) => Ok((named.cloned(), size)),
        (None, None) => Ok((None, None)),
        (Some(named), None) => {
            let file = file_of(option, named, observer)?;
            let size = size_of_model(option, &file.0, observer)?;
            Ok((Some(file), Some(size)))
        }
    }
}

/// Opens the device, checks that it supports the knobs that are set, and sets the knobs whose defaults depend on it.
pub(super) fn open_device(
    spec: &RunSpec,
    knobs: &mut Knobs,
    observer: &dyn Observer,
) -> Result<Device, Failure> {
    let accumulation = match (spec.schedule.deterministic, knobs.accumulation) {
        (true, Some(given)) if !given.is_deterministic() => {
            return Err(OptionProblem::AccumulationConflict { given }.into());
        }
        (true, _) => Some(Accumulation::Slots),
        (false, given) => given,
    };
    let device = Device::open(spec.device.backend, spec.device.gpu.as_deref(), accumulation)?;
    observer.say(format_args!("{}", notes::device(observer.spelling(), &device)));
    check_knobs(knobs, device.kind())?;
    if let Some(method) = device.accumulation() {
        knobs
            .set("accumulation", method.name())
            .map_err(|error| OptionProblem::value("knob", error))?;
        observer.say(format_args!("{}", notes::accumulation(observer.spelling(), method)));
    }
    if choose_moments(knobs, device.kind()) {
        observer
            .say(format_args!("{}", notes::moments(observer.spelling(), knobs.storage.moments)));
    }
    Ok(device)
}

/// Sets the knob `moment_storage` to the default of this backend, unless it is set or that is f32. Returns true if it
/// was.
pub(super) fn choose_moments(knobs: &mut Knobs, kind: BackendKind) -> bool {
    let is_auto =
        knobs.iter().any(|(knob, value)| knob.name == "moment_storage" && value == "auto");
    let chooses = is_auto && kind == BackendKind::Gpu;
    chooses && knobs.set("moment_storage", "both8").is_ok()
}

/// Fails if a knob is set that this backend does not have.
fn check_knobs(knobs: &Knobs, kind: BackendKind) -> Result<(), Failure> {
    for (knob, value) in knobs.changed() {
        if let Some(only_on) = knob.only_on.filter(|only| *only != kind) {
            let problem = OptionProblem::KnobOfOtherBackend {
                knob: knob.name,
                value: value.to_owned(),
                backend: kind,
                only_on,
                default: knob.default,
            };
            return Err(problem.into());
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use densify_render::MomentStorage;

    #[test]
    fn moments_take_the_storage_of_the_backend_unless_it_is_set() {
        for (given, kind, expected) in [
            (None, BackendKind::Cpu, MomentStorage::F32),
            (None, BackendKind::Gpu, MomentStorage::Both8),
            (Some("f32"), BackendKind::Gpu, MomentStorage::F32),
            (Some("both8"), BackendKind::Cpu, MomentStorage::Both8),
        ] {
            let mut knobs = Knobs::default();
            if let Some(value) = given {
                knobs.set("moment_storage", value).expect("a value of this knob");
            }
            choose_moments(&mut knobs, kind);
            assert_eq!(knobs.storage.moments, expected, "{given:?} on {kind:?}");
        }
    }
}
