//! Changes of the options that make a run fit, each verified, cheapest first.

use super::case::Case;
use super::size::MIB;
use crate::failure::{Failure, Remedy};
use crate::spec::knobs::DEFAULT_PRESET;
use crate::spec::{Budget, ByteCount, ImageCache, Partial, Rows, RunSpec, ShDegree};
use densify_data::dataset::Resolution;

/// The preset for runs that are short of memory.
const TINY_MEMORY: &str = "tiny-memory";

impl Remedy {
    /// For new runs, cheapest first: the first three cost time, the fourth view-dependent colours, the others detail.
    pub(super) const NEW_RUN: [Self; 7] = [
        Self::NoImages,
        Self::NoTileCap,
        Self::Preset(TINY_MEMORY),
        Self::LeastDegree,
        Self::Shrink(2),
        Self::Shrink(4),
        Self::Shrink(8),
    ];

    /// The description with this change; `None` if it changes nothing.
    fn apply(self, spec: &RunSpec) -> Option<RunSpec> {
        let mut new = spec.clone();
        let size = &mut new.size;
        match self {
            Self::NoImages => size.image_cache = Some(ImageCache::Bytes(0)),
            Self::NoTileCap => size.tile_cap = None,
            Self::TileCap(pairs) => size.tile_cap = Some(Rows(pairs)),
            Self::Preset(name) => new = with_preset(name, spec)?,
            Self::LeastDegree => {
                let is_fixed = size.full || matches!(size.sh_degree, Some(ShDegree::Fixed(_)));
                size.sh_degree = is_fixed.then_some(ShDegree::Fixed(0)).or(size.sh_degree);
            }
            Self::Shrink(divisor) => new.data.resolution = Some(Resolution::Divisor(divisor)),
            Self::Memory(mib) => size.memory = Some(ByteCount(mib * MIB)),
            Self::Budget(rows) => size.budget = Some(Budget::Rows(rows)),
        }
        (new != *spec).then_some(new)
    }
}

/// The same run with another preset in place of its own; other options stay.
fn with_preset(preset: &str, spec: &RunSpec) -> Option<RunSpec> {
    let own = spec.schedule.preset.as_deref().unwrap_or(DEFAULT_PRESET);
    let (own, defaults) = (Partial::preset(own).ok()?, Partial::all(&RunSpec::default()).ok()?);
    let all = Partial::all(spec).ok()?;
    let is_given = |name: &str| {
        let value = all.get(name);
        name != "preset" && value != defaults.get(name) && value != own.get(name)
    };
    let given = Partial::given(spec, is_given).ok()?;
    Partial::option("preset", preset).over(given).describe().ok()
}

/// Each change that makes the run fit by itself; if there is none, the shortest sequence of the first `changes` that
/// makes it fit. Of several smaller image sizes, only the largest that fits is listed.
pub(super) fn remedies(
    case: &Case<'_>,
    base: &RunSpec,
    changes: &[Remedy],
    fits: impl Fn(&Case<'_>) -> Result<bool, Failure>,
) -> Vec<Vec<Remedy>> {
    // A change that cannot be tried is no remedy.
    let is_remedy = |spec: &RunSpec| case.with(spec).and_then(|case| fits(&case)).unwrap_or(false);
    let shrinks = |change: &Remedy| matches!(change, Remedy::Shrink(_));
    let mut singles = Vec::new();
    let mut together = (Vec::new(), base.clone());
    let (mut is_shrunk, mut joint) = (false, None);
    for &change in changes {
        let alone = change.apply(base).filter(|_| !(shrinks(&change) && is_shrunk));
        if alone.is_some_and(|spec| is_remedy(&spec)) {
            singles.push(vec![change]);
            is_shrunk |= shrinks(&change);
        }
        if let Some(spec) = change.apply(&together.1) {
            together.0.retain(|other| !(shrinks(&change) && shrinks(other)));
            together.0.push(change);
            together.1 = spec;
            if singles.is_empty() && joint.is_none() && is_remedy(&together.1) {
                joint = Some(together.0.clone());
            }
        }
    }
    if singles.is_empty() { joint.into_iter().collect() } else { singles }
}
