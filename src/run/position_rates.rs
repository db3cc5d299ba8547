//! The learning rates of positions in a long capture.
//!
//! They are shares of the extent, and were chosen for cameras around an object, where the extent is about the distance
//! of what a view shows. In a long capture the extent is the length of the route: steps as large would throw Gaussians
//! across what a view shows.

use densify_data::dataset::SeenDepths;
use densify_data::dataset::normalise::EXTENT;

use crate::spec::RunSpec;

/// The median depth of what the views show below which the rates are reduced `[fraction of the extent]`. Cameras around
/// an object see it at 0.4 to 3 extents.
const USUAL_DEPTH: f64 = 0.3;

/// The factor of the default learning rates of positions.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct PositionRates {
    /// In (0, 1].
    pub(crate) factor: f64,
    /// The median depth of what the views show `[fraction of the extent]`.
    depth: f64,
}

impl PositionRates {
    /// The factor for the points that the views show, unless `--lr` sets the rates.
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
                "rates    those of positions times {factor:.2}: half of what the views show is nearer than {depth:.2} of \
                 the extent"
            )
        })
    }
}

#[cfg(test)]
mod tests {
    use densify_core::camera::Camera;
    use glam::{DMat3, DVec3};

    use super::*;

    /// What a camera sees of a wall at this depth `[fraction of the extent]`.
    fn wall(depth: f64) -> SeenDepths {
        let z = depth * EXTENT;
        let camera = Camera::centred((64, 64), (32.0, 32.0), DMat3::IDENTITY, DVec3::ZERO);
        let at = |i: usize| z * (2.0 * (i as f64 + 0.5) / 32.0 - 1.0);
        let points: Vec<DVec3> = (0..1024).map(|i| DVec3::new(at(i % 32), at(i / 32), z)).collect();
        SeenDepths::measure(&points, &[camera])
    }

    #[test]
    fn rates_are_reduced_where_the_views_see_nearer_surfaces_than_usual() {
        let rates = |spec: &str, seen: &SeenDepths| {
            let spec = toml::from_str(spec).expect("a description");
            let rates = PositionRates::choose(&spec, seen);
            ((100.0 * rates.factor).round(), rates.line())
        };
        for depth in [USUAL_DEPTH * 1.001, 1.0, 50.0] {
            assert_eq!(rates("", &wall(depth)), (100.0, None), "{depth}");
        }
        assert_eq!(rates("", &SeenDepths::default()), (100.0, None), "nothing is known");
        let (percent, line) = rates("", &wall(USUAL_DEPTH / 4.0));
        assert_eq!(percent, 25.0);
        assert!(line.expect("a line").contains("times 0.25"));
        let given = "[schedule]\nlr = { mean_start = 1e-4 }";
        assert_eq!(rates(given, &wall(0.01)), (100.0, None), "the user decides");
    }
}
