//! Decides which of the poses that an engine found are right, by what pairs of photographs say about each other.
//!
//! An engine places photographs 60 to 160 degrees wrong with a reprojection error of 0.3 pixels: the points of a false
//! match fit the pose that they led to. But all other matches of such a photograph contradict it. The constants come
//! from the scenes table, layers, room, town, spheres and glossy of `scenegen` (40 to 60 views of 320x240 and 480x360
//! px) and FlightHelmet, by two mappers each, compared with the true poses: no accepted rotation was off by over 0.8°.

use std::fmt;

use glam::{DQuat, DVec3};

/// Limits of the angles between what matches say about a pair and what the model says `[degrees]`.
struct Limits {
    /// Rotation up to which they agree.
    agree: f64,
    /// Rotation from which on they contradict each other.
    contradict: f64,
}

/// Matches of a scene with depth: nine of ten rotations of right pairs are within 1 degree.
const OF_DEPTH: Limits = Limits { agree: 2.0, contradict: 5.0 };
/// Matches on one plane, whose rotation is often off by 3 to 8 degrees where they cover a small part of the picture.
const OF_PLANES: Limits = Limits { agree: 2.0, contradict: 10.0 };
/// The same for the direction from one camera to the other; 95 % of right pairs are within 7 degrees.
const OF_DIRECTIONS: Limits = Limits { agree: 12.0, contradict: 30.0 };
/// Focal length for which the limits hold `[px]`. Shorter ones have larger limits, as a pixel turns a ray further: of
/// cup (190 px), 75 of 77 photographs are accepted instead of 50.
const FOCAL_PX: f64 = 400.0;
/// A pose needs this many agreeing pairs: one alone may be the false match that the pose came from.
const MIN_PAIRS: usize = 2;
/// Least share of agreeing inliers among all of a photograph's pairs that are decided.
const MIN_SHARE: f64 = 0.5;
/// A pose needs this many points.
const MIN_POINTS: usize = 30;
/// Inliers of a pair that joins parts of the view graph.
const MIN_EDGE: u32 = 20;
/// A camera this many median distances from the median centre is misplaced.
const MAX_DISTANCE: f64 = 20.0;
/// Largest share of contradicted photographs in a model that is believed at all. Room, with equal posters on all walls,
/// has at least 0.33 and its other poses are as wrong; town has 0.13, table and layers at most 0.04.
const MAX_CONTRADICTED: f64 = 0.2;

/// A pose to be checked.
#[derive(Debug, Clone, Copy)]
pub(crate) struct View {
    /// Rotation of `camera_from_world`.
    pub(crate) rotation: DQuat,
    /// Translation of `camera_from_world`.
    pub(crate) translation: DVec3,
    /// Number of points that the view shows.
    pub(crate) points: usize,
    /// Focal length `[px]`, > 0.
    pub(crate) focal_px: f64,
}

/// A pair of views whose matches fit one geometry.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Pair {
    pub(crate) views: [usize; 2],
    /// Number of matches that fit.
    pub(crate) inliers: u32,
    /// Rotation from the first camera to the second.
    pub(crate) rotation: DQuat,
    /// Direction of the first camera's centre, seen from the second; `None` if the matches leave it open.
    pub(crate) direction: Option<DVec3>,
}

/// Why a pose is rejected.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Reason {
    /// Too few other photographs confirm it.
    Unconfirmed { pairs: usize },
    /// Most of its matches say otherwise.
    Contradicted { agreeing: u32, contradicting: u32 },
    /// Its best match says otherwise.
    BestPair { view: usize },
    /// It shows too few points.
    FewPoints { points: usize },
    /// It belongs to a part that too few pairs join to the rest.
    Apart,
    /// It lies far from all others.
    Far,
}

impl Reason {
    /// True if matches say that the pose is wrong, rather than nothing.
    fn is_contradiction(self) -> bool {
        matches!(self, Self::Contradicted { .. } | Self::BestPair { .. })
    }
}

impl fmt::Display for Reason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Unconfirmed { pairs: 0 } => write!(f, "no other photograph confirms its pose"),
            Self::Unconfirmed { .. } => write!(f, "only one other photograph confirms its pose"),
            Self::Contradicted { agreeing, contradicting } => {
                write!(
                    f,
                    "{contradicting} of {} matches contradict its pose",
                    agreeing + contradicting
                )
            }
            Self::BestPair { .. } => write!(f, "the photograph most like it contradicts its pose"),
            Self::FewPoints { points } => write!(f, "it shows only {points} points"),
            Self::Apart => write!(f, "too few photographs join its part of the scene to the rest"),
            Self::Far => write!(f, "its camera would be far from all others"),
        }
    }
}

/// What the checks say about a model.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Verdict {
    /// `None` for accepted views. Shape: `[views]`.
    pub(crate) reasons: Vec<Option<Reason>>,
    /// Number of views that matches contradict.
    pub(crate) contradicted: usize,
}

impl Verdict {
    pub(crate) fn accepted(&self) -> usize {
        self.reasons.iter().filter(|reason| reason.is_none()).count()
    }

    /// True if so many views are contradicted or rejected that the others are not to be believed either.
    pub(crate) fn is_hopeless(&self) -> bool {
        let views = self.reasons.len();
        self.contradicted as f64 > MAX_CONTRADICTED * views as f64 || 2 * self.accepted() < views
    }
}

/// A pair's relation to the model.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Relation {
    Agrees,
    Contradicts,
    Undecided,
}

fn relation(views: &[View], pair: &Pair) -> Relation {
    let [first, second] = pair.views.map(|view| views[view]);
    let model = second.rotation * first.rotation.inverse();
    let turned = model.angle_between(pair.rotation).to_degrees();
    let baseline = second.translation - model * first.translation;
    let (limits, aside) = match pair.direction {
        Some(direction) => (OF_DEPTH, baseline.angle_between(direction).to_degrees()),
        None => (OF_PLANES, 0.0),
    };
    let scale = (FOCAL_PX / first.focal_px.min(second.focal_px)).max(1.0);
    let (turned, aside) = (turned / scale, aside / scale);
    // A baseline of length 0 has no direction, so that its angle is NaN and the pair undecided.
    if turned <= limits.agree && aside <= OF_DIRECTIONS.agree {
        Relation::Agrees
    } else if turned > limits.contradict || aside > OF_DIRECTIONS.contradict {
        Relation::Contradicts
    } else {
        Relation::Undecided
    }
}

/// Rejects views, the least supported first, until all that remain support each other.
pub(crate) fn check(views: &[View], pairs: &[Pair]) -> Verdict {
    let mut reasons: Vec<Option<Reason>> = far(views);
    let related: Vec<(Pair, Relation)> =
        pairs.iter().map(|pair| (*pair, relation(views, pair))).collect();
    loop {
        let support = Support::count(views.len(), &related, &reasons);
        let failing = (0..views.len()).filter(|&view| reasons[view].is_none()).filter_map(|view| {
            Some((support.share(view), view, support.fault(view, views[view].points)?))
        });
        // The lowest share goes first, and the first view of equal ones: the order of pairs does not matter.
        let worst = failing.min_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        match worst {
            Some((_, view, reason)) => reasons[view] = Some(reason),
            None => break,
        }
    }
    for view in outside_of_largest_part(&related, &reasons) {
        reasons[view] = Some(Reason::Apart);
    }
    let contradicted = reasons.iter().flatten().filter(|reason| reason.is_contradiction()).count();
    Verdict { reasons, contradicted }
}

/// Rejects cameras far from all others.
fn far(views: &[View]) -> Vec<Option<Reason>> {
    let centres: Vec<DVec3> =
        views.iter().map(|view| -(view.rotation.inverse() * view.translation)).collect();
    let middle =
        DVec3::from_array([0, 1, 2].map(|axis| median(centres.iter().map(|centre| centre[axis]))));
    let reach = MAX_DISTANCE * median(centres.iter().map(|centre| centre.distance(middle)));
    centres.iter().map(|centre| (centre.distance(middle) > reach).then_some(Reason::Far)).collect()
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or_default()
}

/// What the pairs among accepted views say about each of them.
struct Support {
    /// Number of agreeing pairs. Shape of all: `[views]`.
    pairs: Vec<usize>,
    agreeing: Vec<u32>,
    contradicting: Vec<u32>,
    /// Inliers, relation and other view of the pair with most inliers.
    best: Vec<Option<(u32, Relation, usize)>>,
}

impl Support {
    fn count(views: usize, related: &[(Pair, Relation)], reasons: &[Option<Reason>]) -> Self {
        let mut support = Self {
            pairs: vec![0; views],
            agreeing: vec![0; views],
            contradicting: vec![0; views],
            best: vec![None; views],
        };
        for (pair, relation) in related {
            let [first, second] = pair.views;
            if reasons[first].is_some() || reasons[second].is_some() {
                continue;
            }
            for (view, other) in [(first, second), (second, first)] {
                match relation {
                    Relation::Agrees => {
                        support.pairs[view] += 1;
                        support.agreeing[view] += pair.inliers;
                    }
                    Relation::Contradicts => support.contradicting[view] += pair.inliers,
                    Relation::Undecided => {}
                }
                let best = &mut support.best[view];
                let is_better =
                    best.is_none_or(|(inliers, _, known)| (pair.inliers, known) > (inliers, other));
                if is_better {
                    *best = Some((pair.inliers, *relation, other));
                }
            }
        }
        support
    }

    /// The share of agreeing inliers.
    fn share(&self, view: usize) -> f64 {
        let (agreeing, contradicting) =
            (f64::from(self.agreeing[view]), f64::from(self.contradicting[view]));
        agreeing / (agreeing + contradicting).max(1.0)
    }

    fn fault(&self, view: usize, points: usize) -> Option<Reason> {
        let (agreeing, contradicting) = (self.agreeing[view], self.contradicting[view]);
        if contradicting > 0 && self.share(view) < MIN_SHARE {
            return Some(Reason::Contradicted { agreeing, contradicting });
        }
        match self.best[view] {
            Some((_, Relation::Contradicts, other)) => {
                return Some(Reason::BestPair { view: other });
            }
            _ if self.pairs[view] < MIN_PAIRS => {
                return Some(Reason::Unconfirmed { pairs: self.pairs[view] });
            }
            _ => {}
        }
        (points < MIN_POINTS).then_some(Reason::FewPoints { points })
    }
}

/// The accepted views that no chain of strong agreeing pairs joins to the largest part of the view graph.
fn outside_of_largest_part(related: &[(Pair, Relation)], reasons: &[Option<Reason>]) -> Vec<usize> {
    let mut part: Vec<usize> = (0..reasons.len()).collect();
    let mut joined = true;
    // Each view takes the smallest number among the views joined to it, until nothing changes.
    while joined {
        joined = false;
        for (pair, relation) in related {
            let [first, second] = pair.views;
            let are_accepted = reasons[first].is_none() && reasons[second].is_none();
            if are_accepted
                && *relation == Relation::Agrees
                && pair.inliers >= MIN_EDGE
                && part[first] != part[second]
            {
                let least = part[first].min(part[second]);
                (part[first], part[second], joined) = (least, least, true);
            }
        }
    }
    let accepted: Vec<usize> = (0..reasons.len()).filter(|&view| reasons[view].is_none()).collect();
    let size = |number: usize| accepted.iter().filter(|&&view| part[view] == number).count();
    let largest = accepted
        .iter()
        .map(|&view| part[view])
        .max_by_key(|&number| (size(number), usize::MAX - number));
    accepted.into_iter().filter(|&view| Some(part[view]) != largest).collect()
}

#[cfg(test)]
mod tests;
