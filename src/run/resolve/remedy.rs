//! What would make a run fit that does not: changes of its options, each tried, the cheapest first.

use super::{Inputs, RunSpec};
use crate::failure::Failure;
use crate::knobs::DEFAULT_PRESET;
use crate::overlay::Partial;
use crate::values::{ImageCache, Rows, ShDegree};
use densify_data::dataset::Resolution;
use densify_render::BackendKind;

/// The preset of runs that are short of memory.
const SMALL: &str = "tiny-memory";

/// A change of the options.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Change {
    /// No photographs are kept.
    NoImages,
    /// The tile lists are chosen.
    NoTileCap,
    /// The tile lists hold so many pairs.
    TileCap(usize),
    /// The preset is [`SMALL`].
    Preset,
    /// The degree is the lowest.
    LeastDegree,
    /// The photographs are so many times smaller.
    Shrink(u32),
}

impl Change {
    /// Of a new run, the cheapest first: time, then colours that depend on the view, then detail.
    pub(super) const NEW: [Self; 7] = [
        Self::NoImages,
        Self::NoTileCap,
        Self::Preset,
        Self::LeastDegree,
        Self::Shrink(2),
        Self::Shrink(4),
        Self::Shrink(8),
    ];

    /// As the user types it, and the description with it; `None` where it changes nothing.
    fn of(self, spec: &RunSpec, kind: BackendKind) -> Option<(String, RunSpec)> {
        let mut new = spec.clone();
        let size = &mut new.size;
        let words = match self {
            Self::NoImages => {
                size.image_cache = Some(ImageCache::Bytes(0));
                "--image-cache 0".to_owned()
            }
            Self::NoTileCap => {
                size.tile_cap = None;
                "no --tile-cap".to_owned()
            }
            Self::TileCap(pairs) => {
                size.tile_cap = Some(Rows(pairs));
                format!("--tile-cap {pairs}")
            }
            Self::Preset => {
                new = small(spec).filter(|_| kind == BackendKind::Cpu)?;
                format!("--preset {SMALL}")
            }
            Self::LeastDegree => {
                let is_fixed = size.full || matches!(size.sh_degree, Some(ShDegree::Fixed(_)));
                size.sh_degree = is_fixed.then_some(ShDegree::Fixed(0)).or(size.sh_degree);
                "--sh-degree 0".to_owned()
            }
            Self::Shrink(divisor) => {
                new.data.resolution = Some(Resolution::Divisor(divisor));
                format!("-r {divisor}")
            }
        };
        (new != *spec).then_some((words, new))
    }
}

/// The same run with the preset [`SMALL`]: what its own preset set is gone, what else was set stays.
fn small(spec: &RunSpec) -> Option<RunSpec> {
    let own = spec.schedule.preset.as_deref().unwrap_or(DEFAULT_PRESET);
    let (own, defaults) = (Partial::preset(own).ok()?, Partial::all(&RunSpec::default()).ok()?);
    let all = Partial::all(spec).ok()?;
    let is_given = |name: &str| {
        let value = all.get(name);
        name != "preset" && value != defaults.get(name) && value != own.get(name)
    };
    let given = Partial::given(spec, is_given).ok()?;
    Partial::option("preset", SMALL).over(given).describe().ok()
}

/// The changes after which the run `fits`, each alone; or else together, as many as it takes. Of sizes of
/// the photographs only the largest.
pub(super) fn remedies(
    inputs: &Inputs<'_>,
    base: &RunSpec,
    changes: &[Change],
    fits: impl Fn(&Inputs<'_>) -> Result<bool, Failure>,
) -> Vec<String> {
    let kind = inputs.device.kind();
    // What cannot be tried is no remedy.
    let is_remedy = |spec: &RunSpec| inputs.with(spec).and_then(|it| fits(&it)).unwrap_or(false);
    let mut found = Vec::new();
    let mut together = (Vec::<String>::new(), base.clone());
    let (mut is_shrunk, mut joint) = (false, None);
    for &change in changes {
        let shrinks = matches!(change, Change::Shrink(_));
        let alone = change.of(base, kind).filter(|_| !(shrinks && is_shrunk));
        if let Some((words, _)) = alone.filter(|(_, spec)| is_remedy(spec)) {
            found.push(words);
            is_shrunk |= shrinks;
        }
        if let Some((words, spec)) = change.of(&together.1, kind) {
            together.0.retain(|word| !(shrinks && word.starts_with("-r ")));
            together.0.push(words);
            together.1 = spec;
            if found.is_empty() && joint.is_none() && is_remedy(&together.1) {
                joint = Some(together.0.join(" "));
            }
        }
    }
    if found.is_empty() { joint.into_iter().collect() } else { found }
}

/// `A`, `A, or B`, `A, or B, or C`.
pub(super) fn any_of(remedies: &[String]) -> String {
    remedies.join(", or ")
}
