//! Compares a backend's arrays with the reference's.
//!
//! A renderer has thresholds: the smallest alpha, 1/255, the smallest transmittance, and the order of depths. Close to
//! a threshold `f32` and `f64` may decide differently, and the images then differ by more than rounding. So the
//! comparison is tight where no threshold is close. Elsewhere a pixel may flip, but rarely, by a bounded amount, and
//! not always in the same direction: a bias would be a bug. (After gsplat's `assert_close_with_boundary_band`.)

use std::fmt::Write as _;

use densify_render::cpu::ModelGradient;

/// Tolerances of a comparison of images.
#[derive(Debug, Clone, Copy)]
pub struct Limits {
    /// Largest difference of a value where no threshold is close.
    pub interior: f64,
    /// Largest step of a value at a threshold: its difference where a threshold is close.
    pub step: f64,
    /// Largest share of pixels that may differ by more than `interior`; one pixel always may.
    pub flipped: f64,
    /// Largest absolute mean of the signs of these pixels' differences.
    pub bias: f64,
}

impl Limits {
    /// For values around 1 computed on a CPU.
    pub const CPU: Self = Self { interior: 2e-5, step: 1.5 / 255.0, flipped: 0.001, bias: 0.5 };

    /// The tolerances for values around `scale`.
    #[must_use]
    pub fn scaled(self, scale: f64) -> Self {
        Self { interior: self.interior * scale, step: self.step * scale, ..self }
    }
}

/// Minimum number of flipped pixels to test their bias: a bias of ½ is then not due to chance (p < 0.01).
const MIN_FLIPS_FOR_BIAS: usize = 30;

/// Compares two images; returns the largest difference of the pixels that did not flip.
///
/// Shapes: `measured` and `expected` `[pixels, channels]`, `boundary` `[pixels]`, true where a threshold is close.
///
/// # Errors
/// The first pixel that differs by more than its tolerance, or too many flipped pixels.
pub fn compare_images(
    measured: &[f32],
    expected: &[f64],
    boundary: &[bool],
    limits: Limits,
) -> Result<f64, String> {
    let pixels = boundary.len();
    if measured.len() != expected.len() || !expected.len().is_multiple_of(pixels.max(1)) {
        let (found, wanted) = (measured.len(), expected.len());
        return Err(format!("{found} values measured, {wanted} expected, {pixels} pixels"));
    }
    let channels = expected.len() / pixels.max(1);
    let (mut largest, mut flips, mut directions) = (0.0_f64, 0_usize, 0.0);
    for (p, &on_boundary) in boundary.iter().enumerate() {
        let differences =
            (p * channels..(p + 1) * channels).map(|i| f64::from(measured[i]) - expected[i]);
        // The channel that differs most represents the pixel; a NaN counts as the largest difference.
        let worst = differences.fold(0.0_f64, |worst, d| {
            if worst.is_nan() || d.abs() <= worst.abs() { worst } else { d }
        });
        if worst.abs() <= limits.interior {
            largest = largest.max(worst.abs());
        } else if !on_boundary || worst.is_nan() {
            let most = limits.interior;
            return Err(format!(
                "pixel {p} differs by {worst:e}, {most:e} allowed where no threshold is close"
            ));
        } else if worst.abs() > limits.step {
            return Err(format!(
                "pixel {p} differs by {worst:e}, {:e} allowed at a boundary",
                limits.step
            ));
        } else {
            flips += 1;
            directions += worst.signum();
        }
    }
    let max_flips = ((limits.flipped * pixels as f64) as usize).max(1);
    if flips > max_flips {
        return Err(format!(
            "{flips} of {pixels} pixels flipped at a boundary, {max_flips} allowed"
        ));
    }
    let bias = directions / flips.max(1) as f64;
    if flips >= MIN_FLIPS_FOR_BIAS && bias.abs() >= limits.bias {
        return Err(format!("{flips} pixels flipped with bias {bias:.2}, {} allowed", limits.bias));
    }
    Ok(largest)
}

/// max |measured − expected| / max |expected|; 0 if both are all zero, NaN if one holds a NaN.
///
/// # Panics
/// When the arrays differ in length.
pub fn relative_error<M: Copy + Into<f64>>(measured: &[M], expected: &[f64]) -> f64 {
    assert_eq!(measured.len(), expected.len(), "two arrays of one quantity differ in length");
    let mut largest = 0.0_f64;
    let mut worst = 0.0_f64;
    for (&m, &e) in measured.iter().zip(expected) {
        let difference = (m.into() - e).abs();
        largest = largest.max(e.abs());
        // `max` would drop a NaN.
        worst =
            if difference.is_nan() || worst.is_nan() { f64::NAN } else { worst.max(difference) };
    }
    if worst == 0.0 { 0.0 } else { worst / largest }
}

/// All values of a parameter class of a gradient, row after row.
///
/// # Panics
/// When there is no such class.
pub fn class<'a>(gradient: &'a ModelGradient, name: &str) -> &'a [f32] {
    match name {
        "means" => gradient.means.as_flattened(),
        "log_scales" => gradient.log_scales.as_flattened(),
        "quats" => gradient.quats.as_flattened(),
        "opacity_logits" => &gradient.opacity_logits,
        "sh" => &gradient.sh,
        _ => panic!("no parameter class is called {name}"),
    }
}

/// Collects comparisons, so that a failing test reports all failures at once.
#[derive(Debug)]
pub struct Table {
    title: String,
    rows: Vec<(String, String, f64, f64)>,
    messages: Vec<String>,
}

impl Table {
    /// An empty table.
    pub fn new(title: &str) -> Self {
        Self { title: title.into(), rows: Vec::new(), messages: Vec::new() }
    }

    /// Records the error of `quantity` in `case`.
    pub fn check(&mut self, case: &str, quantity: &str, error: f64, tolerance: f64) {
        self.rows.push((case.into(), quantity.into(), error, tolerance));
    }

    /// Records the result of a comparison of images.
    pub fn image(
        &mut self,
        case: &str,
        quantity: &str,
        outcome: Result<f64, String>,
        limits: Limits,
    ) {
        match outcome {
            Ok(error) => self.check(case, quantity, error, limits.interior),
            Err(message) => {
                self.check(case, quantity, f64::NAN, limits.interior);
                self.fail(format!("{case}: {quantity}: {message}"));
            }
        }
    }

    /// Records a failure without a figure.
    pub fn fail(&mut self, message: String) {
        self.messages.push(message);
    }

    /// A text with all failures; `None` if there are none.
    fn failures(&self) -> Option<String> {
        let failed: Vec<_> = self.rows().filter(|row| row.2.is_nan() || row.2 > row.3).collect();
        if failed.is_empty() && self.messages.is_empty() {
            return None;
        }
        let mut text = format!(
            "{}: {} of {} comparisons failed\n",
            self.title,
            failed.len() + self.messages.len(),
            self.rows.len() + self.messages.len()
        );
        for (case, quantity, error, tolerance) in failed {
            let _ = writeln!(text, "  {case:<28} {quantity:<26} {error:9.2e} > {tolerance:.2e}");
        }
        for message in self.messages() {
            let _ = writeln!(text, "  {message}");
        }
        Some(text)
    }

    /// All comparisons: case, quantity, error, tolerance.
    pub fn rows(&self) -> impl Iterator<Item = (&str, &str, f64, f64)> {
        self.rows.iter().map(|(case, quantity, error, tolerance)| {
            (case.as_str(), quantity.as_str(), *error, *tolerance)
        })
    }

    /// All failures without a figure.
    pub fn messages(&self) -> impl Iterator<Item = &str> {
        self.messages.iter().map(String::as_str)
    }

    /// Ends a test; fails it if a comparison failed.
    ///
    /// # Panics
    /// With the table of failures; also if nothing was compared.
    pub fn finish(self) {
        assert!(!self.rows.is_empty(), "{}: nothing was compared", self.title);
        if let Some(failures) = self.failures() {
            panic!("{failures}");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PIXELS: usize = 10_000;

    fn expected() -> Vec<f64> {
        (0..PIXELS).map(|p| (p as f64 * 0.37).sin().abs()).collect()
    }

    /// Every tenth pixel lies on a boundary.
    fn boundary() -> Vec<bool> {
        (0..PIXELS).map(|p| p.is_multiple_of(10)).collect()
    }

    /// The expected image with `by(k)` added to the k-th of the given pixels.
    fn corrupted(pixels: impl Iterator<Item = usize>, by: impl Fn(usize) -> f32) -> Vec<f32> {
        let mut image: Vec<f32> = expected().iter().map(|&v| v as f32).collect();
        for (k, p) in pixels.enumerate() {
            image[p] += by(k);
        }
        image
    }

    fn outcome(image: &[f32], limits: Limits) -> Result<f64, String> {
        compare_images(image, &expected(), &boundary(), limits)
    }

    fn assert_refused(image: &[f32], limits: Limits, reason: &str) {
        let message = outcome(image, limits).expect_err(reason);
        assert!(message.contains(reason), "{message}");
    }

    #[test]
    fn errors_are_distinguished_from_rounding_and_flips() {
        let cpu = Limits::CPU;
        let lenient = Limits { flipped: 0.01, ..cpu };
        let alternating = |k: usize| if k.is_multiple_of(2) { 0.004 } else { -0.004 };
        let rounded = outcome(&corrupted(0..PIXELS, |k| 1e-5 * (k as f32).sin()), cpu);
        assert!((9e-6..2e-5).contains(&rounded.unwrap()));
        // A few flips at boundaries pass.
        assert!(outcome(&corrupted((0..100).step_by(10), alternating), cpu).is_ok());
        assert!(outcome(&corrupted((0..1000).step_by(10), alternating), lenient).is_ok());
        let one = |pixel: usize, by: f32| corrupted([pixel].into_iter(), |_| by);
        assert_refused(&one(4321, 3e-5), cpu, "pixel 4321");
        assert_refused(&one(4321, -0.5), cpu, "pixel 4321");
        assert_refused(&one(7, f32::NAN), cpu, "pixel 7");
        assert_refused(&one(70, f32::NAN), cpu, "pixel 70");
        assert_refused(&one(50, 0.006), cpu, "at a boundary");
        assert_refused(&corrupted((0..110).step_by(10), alternating), cpu, "11 of 10000");
        assert_refused(&corrupted((0..1000).step_by(10), |_| 0.004), lenient, "bias 1.00");
        let mostly_negative = |k: usize| if k.is_multiple_of(5) { 0.004 } else { -0.004 };
        assert_refused(&corrupted((0..1000).step_by(10), mostly_negative), lenient, "bias -0.60");
        assert!(outcome(&[0.0; 5], cpu).is_err(), "lengths that disagree");
        for measured in [[0.0, f32::NAN, 0.5], [f32::NAN, 0.0, 0.0]] {
            // The NaN is not hidden by the next channel.
            assert!(compare_images(&measured, &[0.0; 3], &[true], cpu).is_err());
        }
    }

    #[test]
    fn errors_are_relative_to_the_largest_expected_value() {
        assert!((relative_error(&[1.0_f32, 10.0], &[1.1, 10.0]) - 0.01).abs() < 1e-7);
        assert!(relative_error(&[0.0_f32; 4], &[0.0; 4]) == 0.0);
        assert!(relative_error(&[1e-20_f32], &[0.0]).is_infinite());
        assert!(relative_error(&[1.0, f32::NAN, 2.0], &[1.0, 1.0, 2.0]).is_nan());
    }

    #[test]
    fn a_table_shows_every_failure_and_only_failures() {
        let mut table = Table::new("title");
        table.check("good", "a", 1.0, 2.0);
        table.check("bad", "b", 3.0, 2.0);
        table.check("worse", "c", f64::NAN, 2.0);
        table.fail("and a message".into());
        let text = table.failures().unwrap();
        assert!(text.starts_with("title: 3 of 4 comparisons failed"), "{text}");
        assert!(["bad", "worse", "and a message"].iter().all(|w| text.contains(w)), "{text}");
        assert!(!text.contains("good"), "{text}");
    }
}
