//! Messages to the user that name options, other than errors.

use std::path::Path;

use super::words::{load_error, model_name};
use densify_core::antialiasing::Antialiasing;
use densify_core::memory::Bytes;
use densify_core::numbers::grouped;
use densify_core::spelling::Spelling;
use densify_data::dataset::Note;
use densify_data::models::{Coarseness, offset_text};
use densify_render::{Accumulation, AdapterKind, BackendKind, Device, MomentStorage};

/// The option `antialias` with a value; on the command line, the value must follow `=`.
pub(crate) fn antialias_option(spelling: Spelling, kernel: Antialiasing) -> String {
    match spelling {
        Spelling::Terminal => format!("{}={kernel}", spelling.option("antialias")),
        Spelling::Keyword => spelling.text("antialias", kernel),
    }
}

/// The line that names the device, with a hint where another choice may be better.
pub(crate) fn device(s: Spelling, device: &Device) -> String {
    let device = match device {
        Device::Processor if BackendKind::Gpu.is_built() => {
            "processor (`densify devices` lists GPUs)".to_owned()
        }
        Device::Processor => "processor".to_owned(),
        Device::Gpu(device) => {
            let adapter = device.adapter();
            let hint = match adapter.kind {
                AdapterKind::Software => {
                    format!(", a software driver: {} is faster", s.text("backend", "cpu"))
                }
                _ => String::new(),
            };
            format!("{} ({}){hint}", adapter.name, adapter.interface)
        }
    };
    format!("device   {device}")
}

/// A note about a dataset.
pub(crate) fn dataset(s: Spelling, note: &Note) -> String {
    match note {
        Note::Text(text) => format!("note: {text}"),
        Note::FarCamerasLeftOut { count, names } => format!(
            "note: cameras far from all others, {count} left out (use {} to train on them): {names}",
            s.text("far_cameras", "keep")
        ),
        Note::OtherModels { model, images, others } => {
            let others: Vec<String> =
                others.iter().map(|(model, images)| format!("{model} ({images})")).collect();
            format!(
                "note: of several COLMAP models, {model} is used because it has the most images ({images}), not {} ({} \
                 chooses another)",
                others.join(", "),
                s.text("sparse", "DIR")
            )
        }
        Note::Cropped { percent, photographs } => format!(
            "note: undistortion crops up to {percent:.0} % of each of {photographs} photographs ({} keeps the whole \
             field of view)",
            s.switch("keep_fov")
        ),
        Note::DepthDropped(error) => {
            format!("warning: a view is trained without its depth: {}", load_error(error, s))
        }
        Note::DepthLeftOut(error) => {
            format!("note: the given depth is not used: {}", load_error(error, s))
        }
        Note::DepthScalesDiffer { percent } => format!(
            "note: the scale of the depth differs by {percent:.0} % between views, compared with the points that they \
             see; if the maps hold inverse depth, {} fits each of them",
            s.text("depth_unit", "relative")
        ),
    }
}

/// The line that names the storage of moments that a backend takes by default.
pub(crate) fn moments(s: Spelling, taken: MomentStorage) -> String {
    let name = match taken {
        MomentStorage::F32 => "f32",
        MomentStorage::Both8 => "both8",
    };
    let other = s.member("knob", "moment_storage", "f32");
    format!("moments  moment_storage={name}: one byte each; {other} keeps them whole")
}

/// The line that names the order in which gradients are added up.
pub(crate) fn accumulation(s: Spelling, taken: Accumulation) -> String {
    let note = if taken.is_deterministic() {
        "runs are reproducible byte for byte".to_owned()
    } else {
        format!(
            "results vary slightly between runs; {} makes them reproducible",
            s.switch("deterministic")
        )
    };
    format!("sums     accumulation={taken}: {note}")
}

/// The note that part of what the views show is nearer than the near plane.
pub(crate) fn hidden_points(s: Spelling, near: f64, hidden: &str, is_given: bool) -> String {
    let remedy = if is_given { "; a smaller number shows it" } else { "" };
    let near = s.set("near", near);
    format!("note: {hidden} of what the views show lies nearer than {near}, and is hidden{remedy}")
}

/// The line that names the part of the promised memory that only makes the run faster.
pub(crate) fn for_speed(s: Spelling, needed: u64, speed: u64) -> String {
    format!(
        "needed   {}; the other {} are for speed (longer tile lists, decoded images): with {} they are given up first",
        Bytes(needed),
        Bytes(speed),
        s.option("memory")
    )
}

/// The note that a model's colours are truncated to a lower degree.
pub(crate) fn degree_cut(s: Spelling, own: u8, degree: u8) -> String {
    format!(
        "note: colours of degree {own} are cut to {degree}; {} keeps them",
        s.set("sh_degree", own)
    )
}

/// The note that a model may be in other coordinates.
pub(crate) fn other_coordinates(
    s: Spelling,
    option: Option<&str>,
    file: &Path,
    correlation: f64,
) -> String {
    let model = model_name(s, option, file);
    format!(
        "note: {model}: it shows little of the photographs (their correlation is {correlation:.2}); its coordinates \
         may not be those of the dataset (axes, scale, or origin)"
    )
}

/// The problem that world coordinates are too coarse in f32, with the remedy.
pub(crate) fn coarse(s: Spelling, coarseness: &Coarseness, may_be_double: bool) -> String {
    let local = s.text("coordinates", "local");
    if may_be_double {
        let double = s.text("coordinates", "double");
        return format!("{coarseness}; {local} or {double} keeps positions exact");
    }
    format!("{coarseness}; {local} keeps positions exact")
}

/// The note that a file is in local coordinates because world coordinates are too coarse.
pub(crate) fn saved_in_local(s: Spelling, coarseness: &Coarseness, offset: [f64; 3]) -> String {
    format!(
        "note: saved in local coordinates, relative to the offset {}: {coarseness} (choose others with {} or {})",
        offset_text(offset),
        s.text("coordinates", "world"),
        s.text("coordinates", "double")
    )
}

/// The line before training that world coordinates in f32 will be too coarse for the Gaussians that training may make.
pub(crate) fn expected_coarse(
    s: Spelling,
    coarseness: &Coarseness,
    offset: [f64; 3],
    is_automatic: bool,
) -> String {
    if is_automatic {
        return format!(
            "coords   local, from the offset {}: {coarseness} (choose others with {} or {})",
            offset_text(offset),
            s.text("coordinates", "world"),
            s.text("coordinates", "double")
        );
    }
    format!(
        "note: the saved model will be worse than the trained one: {}",
        coarse(s, coarseness, true)
    )
}

/// The hint on how to refine poses if there are no tracks.
pub(crate) fn refine_poses(s: Spelling) -> String {
    format!("{} refines them anyway", s.text("poses", "refine"))
}

/// The hint on how to learn exposures if the tracks do not show whether exposures differ.
pub(crate) fn learn_exposures(s: Spelling) -> String {
    format!("{} learns exposures anyway", s.text("exposure", "on"))
}

/// The hint on how to learn vignettes if the tracks do not show whether cameras have any.
pub(crate) fn learn_vignettes(s: Spelling) -> String {
    format!("{} learns vignettes anyway", s.text("vignette", "on"))
}

/// The line that names the budget and the reason for it. `most`: the maximum number of rows that the user gave, if any;
/// `solved`: the memory limit if there is one, and true if it determines the number of rows.
pub(crate) fn budget(
    s: Spelling,
    rows: usize,
    is_auto: bool,
    most: Option<usize>,
    solved: Option<(u64, bool)>,
) -> String {
    let rows = grouped(rows);
    let memory = solved.map_or_else(String::new, |(bytes, _)| s.text("memory", Bytes(bytes)));
    let reason = match (solved, is_auto, most) {
        (None, false, None) => {
            format!(" (default; choose with {} or {})", s.option("budget"), s.option("memory"))
        }
        (None, true, _) => " at most (auto: as many as improve the model)".to_owned(),
        (None, false, Some(_)) => String::new(),
        (Some((_, true)), _, Some(given)) => {
            format!(": {memory} holds fewer than {}", s.text("budget", grouped(given)))
        }
        (Some((_, false)), _, Some(_)) => format!(": {memory} would hold as many or more"),
        (Some((_, true)), _, None) => format!(", as many as {memory} holds"),
        (Some((_, false)), _, None) => ", as many as fit the device".to_owned(),
    };
    format!("budget   {rows} rows{reason}")
}

/// The note that the degree was lowered because of the memory limit.
pub(crate) fn degree_lowered(
    s: Spelling,
    [degree, wanted]: [u8; 2],
    at_wanted: usize,
    start: usize,
) -> String {
    format!(
        "note: degree {degree} instead of {wanted}: at degree {wanted} only {} rows fit, but the scene starts with {}; \
         {} enforces degree {wanted}",
        grouped(at_wanted),
        grouped(start),
        s.set("sh_degree", wanted)
    )
}

/// The line that names the unused part of the memory limit.
pub(crate) fn memory_left(s: Spelling, bytes: u64) -> String {
    format!("\n  {:<11} {} of {}", "left", Bytes(bytes), s.option("memory"))
}

/// The note that a run has no iterations left.
pub(crate) fn all_done(s: Spelling, last: u32) -> String {
    format!(
        "note: all {last} iterations are done; {} with a larger number extends the run",
        s.option("iterations")
    )
}
