//! The learning rates of positions in scenes of which each view shows only a small part.
//!
//! The default rates are fractions of the extent, chosen for cameras around an object, where the extent is about the
//! distance of what a view shows. Along a route, the extent is the length of the route: steps in proportion to
//! it would throw Gaussians across everything that a view shows.

use densify_data::dataset::SeenDepths;
use densify_data::dataset::normalise::EXTENT;

use crate::spec::RunSpec;

/// The rates are reduced if the median depth of what the views show is below this `[fraction of the extent]`. The
/// median depth is 0.5 to 2 in scenes around an object or in a room. It is 0.04 in a corridor of 120 m, where a third
/// of the default rates is best.
const USUAL_DEPTH: f64 = 0.12;

/// The reduction of the default learning rates of positions.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct PositionRates {
    /// Factor of the rates, in (0, 1].
    pub(crate) factor: f64,
    /// The median depth of what the views show `[fraction of the extent]`.
    depth: f64,
}

impl PositionRates {
    /// The reduction that the points in the views call for; none if `--lr` sets the rates.
    pub(crate) fn choose(spec: &RunSpec, seen: &SeenDepths) -> Self {
        let is_given = spec.schedule.lr.iter().any(|rate| rate.path[..] == ["mean_start"]);
        let median = seen.quantile(0.5).filter(|_| !is_given);
        let depth = median.map_or(USUAL_DEPTH, |depth| depth / EXTENT);
        Self { factor: (depth / USUAL_DEPTH).clamp(f64::MIN_POSITIVE, 1.0), depth }
    }

    /// A line for the user if the rates are reduced.
    pub(crate) fn line(self) -> Option<String> {
        let Self { factor, depth } = self;
        (factor < 1.0).then(|| {
            format!(
                "rates    position rates times {factor:.2}: half of what the views show is nearer than {depth:.2} of \
                 the extent"
            )
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::near_plane::tests::walls;

    #[test]
    fn rates_are_reduced_where_the_views_see_nearer_surfaces_than_usual() {
        let rates = |spec: &str, seen: &SeenDepths| {
            let spec = toml::from_str(spec).expect("a description");
            let rates = PositionRates::choose(&spec, seen);
            ((100.0 * rates.factor).round() as u32, rates.line())
        };
        for depth in [USUAL_DEPTH * 1.001, 1.0, 50.0] {
            assert_eq!(rates("", &walls(&[depth * EXTENT])), (100, None), "{depth}");
        }
        assert_eq!(rates("", &SeenDepths::default()), (100, None), "nothing is known");
        let (percent, line) = rates("", &walls(&[USUAL_DEPTH / 4.0 * EXTENT]));
        assert_eq!(percent, 25);
        assert!(line.expect("a line").contains("times 0.25"));
        let given = "lr = { mean_start = 1e-4 }";
        assert_eq!(rates(given, &walls(&[0.01 * EXTENT])), (100, None), "the user decides");
    }
}
