//! Tracks: the views in which a reconstruction has found a point.
//!
//! They are read only on request and sampled while being read, because statistics need some thousands of tracks and
//! a reconstruction may have millions.

use std::collections::HashMap;

use glam::DVec3;

use super::normalise::Normalisation;

/// Number of tracks that remain after thinning. At twice this number, every second track is dropped.
const THINNED_TRACKS: usize = 1 << 15;
/// Largest number of views kept per track.
pub(super) const MAX_VIEWS: u64 = 64;
/// Smallest number of views of a track; with fewer, changes of colour with the view cannot be measured.
pub(crate) const MIN_VIEWS: usize = 4;

/// Points and the views that show them, as a structure of arrays.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Tracks {
    /// Positions. Shape: `[tracks]`.
    pub positions: Vec<DVec3>,
    /// sRGB colours from the reconstruction. Shape: `[tracks]`.
    pub colours: Vec<[u8; 3]>,
    /// Indices of training views, ascending and distinct, at least `MIN_VIEWS` per track. Shape: `[tracks]`, then
    /// views.
    pub views: Vec<Vec<u32>>,
    /// Where each of these views shows the point: the direction from its camera, of unit length, in the axes of the world
    /// by the given pose; NaN if the reconstruction does not say. Shape: as `views`, or empty if not
    /// [requested](super::TrackReading).
    pub directions: Vec<Vec<[f32; 3]>>,
}

/// The direction of a point that the reconstruction does not give.
pub(super) const UNKNOWN: [f32; 3] = [f32::NAN; 3];

impl Tracks {
    /// Number of tracks.
    pub fn count(&self) -> usize {
        self.positions.len()
    }

    /// Size in memory `[bytes]`.
    pub fn bytes(&self) -> u64 {
        let track = size_of::<DVec3>() + 3 + size_of::<Vec<u32>>();
        let views: usize = self.views.iter().map(Vec::len).sum();
        let known: usize = self.directions.iter().map(Vec::len).sum();
        let lists = self.directions.len() * size_of::<Vec<[f32; 3]>>();
        let directions = lists + known * size_of::<[f32; 3]>();
        (self.count() * track + views * size_of::<u32>() + directions) as u64
    }

    /// Moves tracks to normalised coordinates and restricts them to training views. `view_of` returns the training view
    /// that shows a point, given the id of the view's photograph.
    pub(super) fn in_training_views(
        self,
        normalisation: &Normalisation,
        view_of: impl Fn(u32, DVec3) -> Option<u32>,
    ) -> Self {
        let mut kept = Self::default();
        let points = self.positions.into_iter().zip(self.colours);
        let has_directions = !self.directions.is_empty();
        let mut directions = self.directions.into_iter();
        for ((position, colour), views) in points.zip(self.views) {
            let position = normalisation.scene_from_world(position);
            let directions = directions.next().unwrap_or_else(|| vec![UNKNOWN; views.len()]);
            let seen = views.into_iter().zip(directions);
            let seen = seen.filter_map(|(id, direction)| Some((view_of(id, position)?, direction)));
            let mut seen: Vec<(u32, [f32; 3])> = seen.collect();
            seen.sort_by_key(|(view, _)| *view);
            seen.dedup_by_key(|(view, _)| *view);
            if position.as_vec3().is_finite() && seen.len() >= MIN_VIEWS {
                kept.positions.push(position);
                kept.colours.push(colour);
                let (views, directions) = seen.into_iter().unzip();
                kept.views.push(views);
                if has_directions {
                    kept.directions.push(directions);
                }
            }
        }
        kept
    }
}

/// Samples tracks while a file is read: all of them, or every second, fourth, … if there are too many.
#[derive(Debug)]
pub(super) struct TrackSampler {
    tracks: Tracks,
    /// Index of the observation in each view's photograph. Shape: as the views of the tracks.
    observations: Vec<Vec<u32>>,
    /// Every `stride`-th track is kept.
    stride: usize,
    seen: usize,
}

impl TrackSampler {
    pub(super) fn new() -> Self {
        Self { tracks: Tracks::default(), observations: Vec::new(), stride: 1, seen: 0 }
    }

    /// Counts the next track; returns true if it must be [added](Self::add).
    pub(super) fn wants(&mut self, views: u64) -> bool {
        if views < MIN_VIEWS as u64 {
            return false;
        }
        self.seen += 1;
        (self.seen - 1).is_multiple_of(self.stride)
    }

    /// Adds a track with the ids of its photographs and its observation in each; only the first [`MAX_VIEWS`] are kept.
    pub(super) fn add(
        &mut self,
        position: DVec3,
        colour: [u8; 3],
        views: impl IntoIterator<Item = (u32, u32)>,
    ) {
        self.tracks.positions.push(position);
        self.tracks.colours.push(colour);
        let (views, observations) = views.into_iter().take(MAX_VIEWS as usize).unzip();
        self.tracks.views.push(views);
        self.observations.push(observations);
        if self.tracks.count() >= 2 * THINNED_TRACKS {
            self.stride *= 2;
            keep_every_second(&mut self.tracks.positions);
            keep_every_second(&mut self.tracks.colours);
            keep_every_second(&mut self.tracks.views);
            keep_every_second(&mut self.observations);
        }
    }

    /// The tracks without directions.
    pub(super) fn finish(self) -> Tracks {
        self.tracks
    }

    /// The tracks with directions. `visit` passes every observation of the photographs to its argument: the photograph's id, the
    /// observation's index in it, and the direction in the axes of the world.
    ///
    /// # Errors
    /// Those of `visit`.
    pub(super) fn finish_with_directions<E>(
        self,
        visit: impl FnOnce(&mut dyn FnMut(u32, u32, DVec3)) -> Result<(), E>,
    ) -> Result<Tracks, E> {
        let Self { mut tracks, observations, .. } = self;
        tracks.directions = tracks.views.iter().map(|views| vec![UNKNOWN; views.len()]).collect();
        let mut wanted: HashMap<(u32, u32), (u32, u32)> = HashMap::new();
        for (track, (views, observations)) in tracks.views.iter().zip(&observations).enumerate() {
            for (place, key) in views.iter().copied().zip(observations.iter().copied()).enumerate()
            {
                wanted.insert(key, (track as u32, place as u32));
            }
        }
        let directions = &mut tracks.directions;
        visit(&mut |id, observation, direction| {
            if let Some(&(track, place)) = wanted.get(&(id, observation)) {
                directions[track as usize][place as usize] = direction.as_vec3().to_array();
            }
        })?;
        Ok(tracks)
    }
}

fn keep_every_second<T>(values: &mut Vec<T>) {
    let mut index = 0;
    values.retain(|_| {
        index += 1;
        index % 2 == 1
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn many_tracks_are_thinned_evenly_and_tracks_of_few_views_left_out() {
        let mut sampler = TrackSampler::new();
        for i in 0..5 * THINNED_TRACKS {
            let views = if i % 2 == 0 { 5 } else { 3 };
            if sampler.wants(views) {
                sampler.add(
                    DVec3::splat(i as f64),
                    [0; 3],
                    (0..views as u32).map(|id| (id, i as u32)),
                );
            }
        }
        let tracks = sampler
            .finish_with_directions(|see| {
                see(2, 8, DVec3::X);
                see(2, 9, DVec3::Y);
                Ok::<_, ()>(())
            })
            .unwrap();
        let count = tracks.count();
        assert!((THINNED_TRACKS..2 * THINNED_TRACKS).contains(&count), "{count}");
        let gaps: Vec<f64> = tracks.positions.windows(2).map(|p| p[1].x - p[0].x).collect();
        assert!(gaps.iter().all(|gap| (gap - 4.0).abs() < 1e-9), "{:?}", &gaps[..4]);
        assert!(tracks.views.iter().all(|views| views.len() == 5));
        // Track 2 is the observation 8 of each photograph; no track is 9.
        let known = |directions: &Vec<[f32; 3]>| directions.iter().any(|d| d[0].is_finite());
        assert_eq!(tracks.directions.iter().position(known), Some(2));
        assert_eq!(
            tracks.directions[2][2].map(f32::to_bits),
            [1.0_f32, 0.0, 0.0].map(f32::to_bits)
        );
    }

    #[test]
    fn only_training_views_count() {
        let tracks = Tracks {
            positions: vec![DVec3::ZERO, DVec3::ONE, DVec3::NAN],
            colours: vec![[1; 3], [2; 3], [3; 3]],
            views: vec![vec![9, 7, 5, 3, 3], vec![9, 7, 5, 4], vec![1, 3, 5, 7]],
            directions: vec![
                (0..5).map(|i| [i as f32; 3]).collect(),
                vec![[0.0; 3]; 4],
                vec![[0.0; 3]; 4],
            ],
        };
        let odd = |id: u32, _| (id % 2 == 1).then_some(id / 2);
        let kept = tracks.in_training_views(&Normalisation::IDENTITY, odd);
        assert_eq!(kept.views, [vec![1, 2, 3, 4]], "the second has three training views");
        let first: Vec<f32> = kept.directions[0].iter().map(|direction| direction[0]).collect();
        assert_eq!(format!("{first:?}"), "[3.0, 2.0, 1.0, 0.0]");
    }
}
