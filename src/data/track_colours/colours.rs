//! The colours of tracks in their views, and the gains of the views that best explain the differences.

use crate::dataset::{MIN_VIEWS, Tracks, View};
use crate::error::LoadError;
use densify_core::image::Image8;
use densify_core::vignette::Vignette;

/// Rounds of alternately fitting gains and colours of tracks.
const ROUNDS: usize = 3;
/// Values used to fit gains; darker ones are noise, brighter ones may be clipped.
pub(crate) const TRUSTED: std::ops::RangeInclusive<u8> = 16..=245;
/// Smallest number of trusted values of a view; with fewer, its gain stays 1.
const MIN_COLOURS: usize = 30;

/// The colours of a track in one view.
#[derive(Debug, Clone, Copy)]
pub(super) struct Observation {
    pub(super) track: u32,
    /// Index of the view.
    pub(super) view: u32,
    /// Colour at the point.
    pub(super) centre: [u8; 3],
    /// Smallest values of the pixel at the point and of its neighbours.
    pub(super) lowest: [u8; 3],
    /// Largest values of these pixels.
    pub(super) highest: [u8; 3],
}

/// Peak memory for reading and measuring the colours of tracks, in addition to an image `[bytes]`.
pub fn bytes(tracks: &Tracks) -> u64 {
    let colours: usize = tracks.views.iter().map(Vec::len).sum();
    // The observations and, for each, two differences per channel, whose medians are taken.
    (colours * (size_of::<Observation>() + 6 * size_of::<f32>())) as u64
}

/// The observed colours of all tracks, and the gains and track colours fitted to them.
#[derive(Debug, Clone)]
pub struct TrackColours {
    /// Observations by track, then by view.
    observations: Vec<Observation>,
    /// The fit of each channel.
    fits: [Fit; 3],
}

/// Gains of the views and colours of the tracks in one channel.
#[derive(Debug, Clone)]
struct Fit {
    /// True for views with enough trusted values. Shape: `[views]`.
    is_known: Vec<bool>,
    /// Gains. Shape: `[views]`.
    gains: Vec<f32>,
    /// Colours of the tracks with enough views. Shape: `[tracks]`.
    references: Vec<f32>,
}

impl TrackColours {
    /// Reads the colours of tracks in their views; each image is decoded once.
    ///
    /// # Errors
    /// When an image cannot be read.
    pub fn read(tracks: &Tracks, views: &[View]) -> Result<Self, LoadError> {
        let mut tracks_in = vec![Vec::new(); views.len()];
        for (track, seen_by) in tracks.views.iter().enumerate() {
            for &view in seen_by {
                if let Some(tracks) = tracks_in.get_mut(view as usize) {
                    tracks.push(track as u32);
                }
            }
        }
        let mut observations = Vec::new();
        for ((number, view), numbers) in (0_u32..).zip(views).zip(tracks_in) {
            if numbers.is_empty() {
                continue;
            }
            let image = view.source.load()?;
            observations.extend(numbers.into_iter().filter_map(|track| {
                let (pixel, depth) = view.camera.project(tracks.positions[track as usize]);
                let (centre, lowest, highest) =
                    (depth > 0.0).then(|| neighbourhood(&image, pixel))??;
                Some(Observation { track, view: number, centre, lowest, highest })
            }));
        }
        // A stable sort: views stay in order within a track.
        observations.sort_by_key(|colour| colour.track);
        let by_track: Vec<&[Observation]> = by_track(&observations).collect();
        let fits = std::array::from_fn(|channel| fit(&by_track, views.len(), channel));
        Ok(Self { observations, fits })
    }

    /// Brightens the colours as if the views had no vignettes, and fits gains and track colours again. `vignettes` has
    /// the vignette of each view, if there is one.
    pub fn undo_vignettes(
        &mut self,
        tracks: &Tracks,
        views: &[View],
        vignettes: &[Option<Vignette>],
    ) {
        for colour in &mut self.observations {
            let view = colour.view as usize;
            let Some(vignette) = vignettes[view] else { continue };
            let (pixel, _) = views[view].camera.project(tracks.positions[colour.track as usize]);
            for values in [&mut colour.centre, &mut colour.lowest, &mut colour.highest] {
                let seen = values.map(|value| f32::from(value) / 255.0);
                let undone = vignette.undo(pixel.x as usize, pixel.y as usize, 1.0, seen);
                // The cast saturates; values at the limits are not trusted.
                *values = undone.map(|value| (255.0 * value).round() as u8);
            }
        }
        let by_track: Vec<&[Observation]> = by_track(&self.observations).collect();
        self.fits = std::array::from_fn(|channel| fit(&by_track, views.len(), channel));
    }

    /// The observations of each track with enough views.
    pub(super) fn by_track(&self) -> impl Iterator<Item = &[Observation]> {
        by_track(&self.observations)
    }

    /// The gains of a view; 1 in channels with too few trusted values.
    pub fn gains(&self, view: usize) -> [f32; 3] {
        self.fits.each_ref().map(|fit| fit.gains[view])
    }

    /// Returns true if a view has enough trusted values in every channel.
    pub fn knows(&self, view: usize) -> bool {
        self.fits.iter().all(|fit| fit.is_known[view])
    }

    /// Number of views.
    pub fn views(&self) -> usize {
        self.fits[0].gains.len()
    }

    /// The fitted colour of a track, by its index among the tracks with enough views.
    pub(super) fn reference(&self, index: usize) -> [f32; 3] {
        self.fits.each_ref().map(|fit| fit.references[index])
    }
}

fn by_track(observations: &[Observation]) -> impl Iterator<Item = &[Observation]> {
    let tracks = observations.chunk_by(|a, b| a.track == b.track);
    tracks.filter(|colours| colours.len() >= MIN_VIEWS)
}

impl Observation {
    /// Squared distance of a colour from the observed range, mean over the channels.
    pub(super) fn squared_difference(&self, colour: [f32; 3], gains: [f32; 3]) -> f64 {
        let square = |channel: usize| {
            let expected = colour[channel] * gains[channel];
            let below = f32::from(self.lowest[channel]) - expected;
            let above = expected - f32::from(self.highest[channel]);
            f64::from(below.max(above).max(0.0)).powi(2)
        };
        (square(0) + square(1) + square(2)) / 3.0
    }
}

/// The colour of a pixel, and the smallest and largest values among it and its eight neighbours; `None`
/// unless all nine are inside the image, opaque and not masked.
fn neighbourhood(image: &Image8, pixel: glam::DVec2) -> Option<([u8; 3], [u8; 3], [u8; 3])> {
    let (width, height) = (i64::from(image.width), i64::from(image.height));
    let (x, y) = (pixel.x.floor() as i64, pixel.y.floor() as i64);
    if !(1..width - 1).contains(&x) || !(1..height - 1).contains(&y) {
        return None;
    }
    let (mut lowest, mut highest) = ([u8::MAX; 3], [u8::MIN; 3]);
    let at = |x: i64, y: i64| (y * width + x) as usize;
    for index in (y - 1..=y + 1).flat_map(|y| (x - 1..=x + 1).map(move |x| at(x, y))) {
        let whole = |plane: &Option<Vec<u8>>| plane.as_ref().is_none_or(|p| p[index] == u8::MAX);
        if !whole(&image.alpha) || !whole(&image.mask) {
            return None;
        }
        for channel in 0..3 {
            let value = image.rgb[3 * index + channel];
            lowest[channel] = lowest[channel].min(value);
            highest[channel] = highest[channel].max(value);
        }
    }
    let centre = std::array::from_fn(|channel| image.rgb[3 * at(x, y) + channel]);
    Some((centre, lowest, highest))
}

/// Fits the gains of the views and the colours of the tracks in one channel. An exposure is nearly a factor on
/// sRGB-encoded values, too, because the sRGB curve is nearly a power function.
fn fit(by_track: &[&[Observation]], views: usize, channel: usize) -> Fit {
    let (mut gains, mut is_known) = (vec![1.0_f32; views], vec![false; views]);
    let mut references = vec![0.0_f32; by_track.len()];
    let mut buffer = Vec::new();
    for round in 0..=ROUNDS {
        for (reference, colours) in references.iter_mut().zip(by_track) {
            buffer.clear();
            let estimate = |c: &Observation| f32::from(c.centre[channel]) / gains[c.view as usize];
            buffer.extend(colours.iter().map(estimate));
            *reference = median(&mut buffer);
        }
        if round == ROUNDS {
            break;
        }
        let mut ratios: Vec<Vec<f32>> = vec![Vec::new(); views];
        for (reference, colours) in references.iter().zip(by_track) {
            for colour in colours.iter().filter(|c| TRUSTED.contains(&c.centre[channel])) {
                let ratio = f32::from(colour.centre[channel]) / reference.max(1.0);
                ratios[colour.view as usize].push(ratio);
            }
        }
        for ((gain, is_known), ratios) in gains.iter_mut().zip(&mut is_known).zip(&mut ratios) {
            if ratios.len() >= MIN_COLOURS {
                (*gain, *is_known) = (median(ratios), true);
            }
        }
    }
    Fit { is_known, gains, references }
}

/// The lower median; 0 without values.
pub(super) fn median(values: &mut [f32]) -> f32 {
    if values.is_empty() {
        return 0.0;
    }
    let middle = (values.len() - 1) / 2;
    *values.select_nth_unstable_by(middle, f32::total_cmp).1
}
