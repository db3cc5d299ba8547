//! Schedules of a run: step sizes, spherical-harmonic degree, view order, background.
//!
//! Every schedule is a pure function of its arguments, so that a run can be reproduced, or resumed at any step without
//! replaying the earlier steps. Constants are those of Kerbl et al., *3D Gaussian Splatting for Real-Time Radiance
//! Field Rendering* (SIGGRAPH 2023), section 5 and its published code, for a run of 30,000 steps; they are scaled in
//! proportion to the length of a run.

use std::fmt;
use std::str::FromStr;

use densify_policies::policy::{PixelLoss, RateOverrides};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use densify_core::gaussians::MAX_SH_DEGREE;
use densify_render::LearningRates;

/// Length of the run for which the published constants were chosen `[steps]`.
pub use densify_policies::parameters::REFERENCE_ITERATIONS;

/// Step sizes (learning rates) of a run. The step size of the means is a fraction of the scene's extent and falls
/// log-linearly over the run. Apart from `fade` and `boost`, all others are constant unless their value at the end is
/// given.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RateOptions {
    /// Means at the start of the run `[fraction of the extent per step]`, ≥ 0. A step size that is 0 at the start is 0
    /// in the whole run, so that its parameters do not change.
    pub mean_start: f64,
    /// Means at the end of the run `[fraction of the extent per step]`, > 0.
    pub mean_end: f64,
    /// Noise of policies that move means randomly, at the end of the run `[fraction of the extent per step]`, > 0. `None`
    /// means as `mean_end`.
    pub noise_end: Option<f64>,
    /// Log-scales, ≥ 0.
    pub log_scale: f32,
    /// Quaternions, ≥ 0.
    pub quat: f32,
    /// Opacity logits, ≥ 0. The first release of 3DGS used 0.05; releases since October 2024 use 0.025.
    pub opacity: f32,
    /// Spherical-harmonic coefficients of band 0, ≥ 0.
    pub sh_dc: f32,
    /// Spherical-harmonic coefficients of bands 1–3, ≥ 0.
    pub sh_rest: f32,
    /// Log-scales at the end of the run, > 0. For this and the next four fields, `None` means the same as at the start.
    pub log_scale_end: Option<f32>,
    /// Quaternions at the end of the run.
    pub quat_end: Option<f32>,
    /// Opacity logits at the end of the run.
    pub opacity_end: Option<f32>,
    /// Spherical-harmonic coefficients of band 0 at the end of the run.
    pub sh_dc_end: Option<f32>,
    /// Spherical-harmonic coefficients of bands 1–3 at the end of the run.
    pub sh_rest_end: Option<f32>,
    /// Final factor of the step sizes of opacities and all spherical-harmonic coefficients, > 0. The factor is 1 up to
    /// `fade_from` and then changes log-linearly.
    pub fade: f64,
    /// Fraction of the run after which these step sizes fade, in (0, 1].
    pub fade_from: f64,
    /// Initial factor of all step sizes, > 0. It falls log-linearly to 1 at the end of the run, so that the last steps
    /// are as fine as in a long run.
    pub boost: f64,
}

impl Default for RateOptions {
    fn default() -> Self {
        Self::PUBLISHED
    }
}

impl RateOptions {
    /// The published step sizes.
    pub const PUBLISHED: Self = Self {
        mean_start: 1.6e-4,
        mean_end: 1.6e-6,
        noise_end: None,
        log_scale: 5e-3,
        quat: 1e-3,
        opacity: 0.025,
        sh_dc: 2.5e-3,
        sh_rest: 1.25e-4,
        log_scale_end: None,
        quat_end: None,
        opacity_end: None,
        sh_dc_end: None,
        sh_rest_end: None,
        fade: 1.0,
        fade_from: 1.0,
        boost: 1.0,
    };

    /// The default step sizes of a run. With s = 30,000 / iterations, at least 1, runs of fewer than 30,000 iterations
    /// start with s^0.6 times the published step sizes, at most 5 times; colour bands 1–3 keep a factor of min(s^0.6, 2)
    /// to the end. With [`PixelLoss::Huber`], log-scales keep that factor too, and the means end with s^0.77 times the
    /// published step size, at most 10 times; noise ends as published.
    ///
    /// Short runs must reach the same result in fewer steps. With the published step sizes, Gaussians stayed far from
    /// their optimum, with training views as blurred as test views, and view-dependent colour, which has the smallest
    /// steps and starts last, lagged behind. The factors are those with which half of the iterations reach the scores of
    /// the earlier rules (`docs/studies/short-runs.tsv`). With a larger boost, training diverges on photographs.
    pub fn for_run(iterations: u32, pixel_loss: PixelLoss) -> Self {
        let shortage = f64::from(REFERENCE_ITERATIONS) / f64::from(iterations.max(1));
        let boost = shortage.powf(0.6).clamp(1.0, 5.0);
        let published = Self::PUBLISHED;
        let kept = boost.min(2.0) as f32;
        let rates = Self { boost, sh_rest: published.sh_rest * kept, ..published };
        match pixel_loss {
            PixelLoss::L1 => rates,
            PixelLoss::Huber => Self {
                mean_end: published.mean_end * shortage.powf(0.77).clamp(1.0, 10.0),
                noise_end: (shortage > 1.0).then_some(published.mean_end),
                log_scale: published.log_scale * kept,
                ..rates
            },
        }
    }

    /// These step sizes with the final ones in the whole run, for models that are trained already: larger steps would
    /// cost such models 4 to 6 dB at first.
    #[must_use]
    pub fn fine(self) -> Self {
        Self {
            mean_start: self.mean_end,
            noise_end: None,
            log_scale: self.log_scale_end.unwrap_or(self.log_scale),
            quat: self.quat_end.unwrap_or(self.quat),
            opacity: self.opacity_end.unwrap_or(self.opacity),
            sh_dc: self.sh_dc_end.unwrap_or(self.sh_dc),
            sh_rest: self.sh_rest_end.unwrap_or(self.sh_rest),
            log_scale_end: None,
            quat_end: None,
            opacity_end: None,
            sh_dc_end: None,
            sh_rest_end: None,
            boost: 1.0,
            ..self
        }
    }

    /// These step sizes, replaced where a policy overrides them.
    #[must_use]
    pub fn with(self, overrides: &RateOverrides) -> Self {
        let mut rates = self;
        if let Some(mean) = overrides.mean {
            (rates.mean_start, rates.mean_end) = (mean.start, mean.end);
            rates.noise_end = None;
        }
        for (start, end, rate) in [
            (&mut rates.log_scale, &mut rates.log_scale_end, overrides.log_scale),
            (&mut rates.quat, &mut rates.quat_end, overrides.quat),
            (&mut rates.opacity, &mut rates.opacity_end, overrides.opacity),
            (&mut rates.sh_dc, &mut rates.sh_dc_end, overrides.sh_dc),
            (&mut rates.sh_rest, &mut rates.sh_rest_end, overrides.sh_rest),
        ] {
            if let Some(rate) = rate {
                let (first, last) = (rate.start as f32, rate.end as f32);
                *start = first;
                *end = (last.to_bits() != first.to_bits()).then_some(last);
            }
        }
        if let Some(fade) = overrides.fade {
            (rates.fade, rates.fade_from) = (fade.to, fade.from);
        }
        rates
    }

    /// Step sizes of iteration `step` (1-based) in a scene of this extent `[scene units]`.
    pub fn at(&self, step: u32, iterations: u32, extent: f32) -> LearningRates {
        let t = f64::from(step.min(iterations)) / f64::from(iterations.max(1));
        let between = |start: f64, end: f64| {
            if start > 0.0 { ((1.0 - t) * start.ln() + t * end.ln()).exp() } else { 0.0 }
        };
        let extent = f64::from(extent);
        let mean = between(self.mean_start, self.mean_end) * extent;
        let noise = between(self.mean_start, self.noise_end.unwrap_or(self.mean_end)) * extent;
        let factor = self.boost.powf(1.0 - t);
        let late = (t - self.fade_from).max(0.0) / (1.0 - self.fade_from).max(f64::MIN_POSITIVE);
        let faded = factor * self.fade.powf(late);
        let times = |factor: f64, start: f32, end: Option<f32>| {
            let start = f64::from(start);
            (end.map_or(start, |end| between(start, f64::from(end))) * factor) as f32
        };
        LearningRates {
            mean: (mean * factor) as f32,
            noise: noise as f32,
            log_scale: times(factor, self.log_scale, self.log_scale_end),
            quat: times(factor, self.quat, self.quat_end),
            opacity: times(faded, self.opacity, self.opacity_end),
            sh_dc: times(faded, self.sh_dc, self.sh_dc_end),
            sh_rest: times(faded, self.sh_rest, self.sh_rest_end),
        }
    }

    /// A message with the name of the first invalid value and the values allowed; `None` if all values are valid.
    pub fn problem(&self) -> Option<String> {
        let end = |end: Option<f32>| f64::from(end.unwrap_or(1.0));
        let may_be_0 = [
            ("mean_start", self.mean_start),
            ("log_scale", f64::from(self.log_scale)),
            ("quat", f64::from(self.quat)),
            ("opacity", f64::from(self.opacity)),
            ("sh_dc", f64::from(self.sh_dc)),
            ("sh_rest", f64::from(self.sh_rest)),
        ];
        let above_0 = [
            ("mean_end", self.mean_end),
            ("noise_end", self.noise_end.unwrap_or(1.0)),
            ("boost", self.boost),
            ("fade", self.fade),
            ("fade_from", self.fade_from),
            ("log_scale_end", end(self.log_scale_end)),
            ("quat_end", end(self.quat_end)),
            ("opacity_end", end(self.opacity_end)),
            ("sh_dc_end", end(self.sh_dc_end)),
            ("sh_rest_end", end(self.sh_rest_end)),
        ];
        let negative = may_be_0.iter().find(|(_, rate)| !(rate.is_finite() && *rate >= 0.0));
        let not_positive = above_0.iter().find(|(_, value)| !(value.is_finite() && *value > 0.0));
        negative
            .map(|(name, _)| format!("{name} must be a positive number, or 0 to freeze its values"))
            .or_else(|| not_positive.map(|(name, _)| format!("{name} must be a positive number")))
    }
}

/// Step sizes of a run that starts from an existing model.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum InitRates {
    /// The final step sizes of a run: the model keeps what it has learned
    #[default]
    Fine,
    /// The step sizes of a run from its start: the model may change a lot
    Full,
}

/// Scales a number of steps for a run of [`REFERENCE_ITERATIONS`] to a run of `iterations`; at least 1.
pub fn scaled(steps: u32, iterations: u32) -> u32 {
    let exact = u64::from(steps) * u64::from(iterations);
    let reference = u64::from(REFERENCE_ITERATIONS);
    let rounded = (exact + reference / 2) / reference;
    u32::try_from(rounded.max(1)).unwrap_or(u32::MAX)
}

/// Spherical-harmonic degree of iteration `step`: it starts at 0 and rises by one every 1,000 steps of a run of 30,000,
/// up to `highest`.
pub fn sh_degree(step: u32, iterations: u32, highest: u8) -> u8 {
    let reached = step / scaled(1_000, iterations);
    u8::try_from(reached).unwrap_or(u8::MAX).min(highest).min(MAX_SH_DEGREE)
}

/// Background colour behind the Gaussians. The text form is `black`, `white`, `random` or `#rrggbb`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Background {
    /// (0, 0, 0).
    Black,
    /// (1, 1, 1).
    White,
    /// An sRGB-encoded colour.
    Colour([u8; 3]),
    /// A new colour at each step, uniform in `[0, 1]`³.
    Random,
}

impl Background {
    /// The background of a training step.
    pub fn at(self, seed: u64, step: u32) -> [f32; 3] {
        match self {
            Self::Random => {
                let mut draws = random_stream(seed, Purpose::Background, u64::from(step));
                // The top 24 bits fill an f32's significand exactly.
                std::array::from_fn(|_| (draws.next_u32() >> 8) as f32 / 16_777_215.0)
            }
            fixed => fixed.fixed(),
        }
    }

    /// The background for evaluation, which is black if training uses random backgrounds.
    pub fn fixed(self) -> [f32; 3] {
        match self {
            Self::Black | Self::Random => [0.0; 3],
            Self::White => [1.0; 3],
            Self::Colour(rgb) => rgb.map(|channel| f32::from(channel) / 255.0),
        }
    }
}

impl fmt::Display for Background {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Black => f.write_str("black"),
            Self::White => f.write_str("white"),
            Self::Random => f.write_str("random"),
            Self::Colour([r, g, b]) => write!(f, "#{r:02x}{g:02x}{b:02x}"),
        }
    }
}

impl FromStr for Background {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let colour = |hex: &str| {
            let value = u32::from_str_radix(hex, 16).ok()?;
            let [_, r, g, b] = value.to_be_bytes();
            // `from_str_radix` also accepts a sign.
            (hex.len() == 6 && !hex.starts_with('+')).then_some(Self::Colour([r, g, b]))
        };
        match text {
            "black" => Ok(Self::Black),
            "white" => Ok(Self::White),
            "random" => Ok(Self::Random),
            _ => text.strip_prefix('#').and_then(colour).ok_or_else(|| {
                format!("`{text}` is not a background; give black, white, random or a colour such as #808080")
            }),
        }
    }
}

impl<'de> Deserialize<'de> for Background {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        densify_core::numbers::number_or_text(deserializer)
    }
}

impl Serialize for Background {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

/// The order of training views in an epoch (0-based): a random permutation of `0..views` that depends on seed and
/// epoch.
pub fn view_order(views: usize, seed: u64, epoch: u32) -> Vec<usize> {
    let mut order: Vec<usize> = (0..views).collect();
    let mut draws = random_stream(seed, Purpose::Views, u64::from(epoch));
    // Fisher–Yates, implemented here because the shuffle of a library may change with its version.
    for last in (1..views).rev() {
        order.swap(last, below(&mut draws, last as u64 + 1) as usize);
    }
    order
}

/// A random sample of `count` training views without replacement that depends on seed and step; all views if there are
/// fewer. These views are rendered for the policy's decisions and for the automatic budget.
pub fn fresh_views(views: usize, count: usize, seed: u64, step: u32) -> Vec<usize> {
    let mut chosen: Vec<usize> = (0..views).collect();
    let mut draws = random_stream(seed, Purpose::FreshViews, u64::from(step));
    sample(&mut chosen, count.min(views), &mut draws);
    chosen
}

/// Keeps a uniform random sample of `count` values: the first elements of a Fisher–Yates shuffle, implemented here
/// because the sampling functions of a library may change with its version.
pub(crate) fn sample(values: &mut Vec<usize>, count: usize, rng: &mut ChaCha8Rng) {
    for place in 0..count {
        let other = place + below(rng, (values.len() - place) as u64) as usize;
        values.swap(place, other);
    }
    values.truncate(count);
}

/// Purposes of random numbers. The streams for different purposes are independent.
#[derive(Debug, Clone, Copy)]
enum Purpose {
    Views = 1,
    Background = 2,
    FreshViews = 3,
}

/// Stream number `counter` of the random numbers for a purpose. ChaCha is a hash of (key, stream, position).
fn random_stream(seed: u64, purpose: Purpose, counter: u64) -> ChaCha8Rng {
    let mut key = [0_u8; 32];
    key[..8].copy_from_slice(&seed.to_le_bytes());
    key[8] = purpose as u8;
    let mut rng = ChaCha8Rng::from_seed(key);
    rng.set_stream(counter);
    rng
}

/// A random number in `0..n`: the high half of a 64 × 64-bit product, with a bias of at most n / 2⁶⁴.
fn below(rng: &mut ChaCha8Rng, n: u64) -> u64 {
    ((u128::from(rng.next_u64()) * u128::from(n)) >> 64) as u64
}

#[cfg(test)]
mod tests;
