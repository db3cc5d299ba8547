//! The vignettes of a run, and their optimiser.

use serde::{Deserialize, Serialize};

use crate::adam::Step;
use densify_core::camera::Camera;
use densify_core::vignette::{COEFFICIENTS, CORNER, PhotographPlace, Vignette, light};

/// Step size at the start of a run, of the term of each coefficient at the corner of a square photograph. A camera
/// without evidence must learn its vignette before the colours of the Gaussians depend on the view and absorb it: with a
/// fourth of this rate, a stop costs 2 dB instead of half a decibel (docs/studies/vignette.tsv).
const RATE: f64 = 0.02;
/// The same for a camera that starts from the colours of tracks, which are a better guide than a model that has just
/// begun.
const RATE_OF_KNOWN: f64 = 0.002;
/// Step size at the end of a run, relative to that at the start.
const FADE: f64 = 0.1;
/// Weight of the squared terms at the corner of a square photograph in the loss. The rest of the loss rises by about a
/// tenth of the square of an error there.
const REGULARISATION: f32 = 1e-4;
/// The same for the difference from the colours of tracks. Colours that depend on the view explain a vignette almost as
/// well, so that the loss alone would let it fade away within some thousand steps.
const REGULARISATION_OF_KNOWN: f32 = 1e-3;
/// r² at the corner of a square photograph, the largest of all.
const LARGEST: f32 = 0.5;

/// The vignettes of all cameras.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Vignettes {
    cameras: Vec<CameraVignette>,
    views: Vec<ViewPlace>,
}

/// The learned state of a camera.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct CameraVignette {
    /// a₁ to a₃.
    values: [f32; COEFFICIENTS],
    /// The values to start with, towards which the others are drawn.
    start: [f32; COEFFICIENTS],
    /// True if the start is that of the colours of tracks.
    is_known: bool,
    /// Adam's first moments.
    first: [f32; COEFFICIENTS],
    /// Adam's second moments.
    second: [f32; COEFFICIENTS],
    /// Number of steps so far.
    age: u32,
}

/// The camera of a view, and the place of the view's pixels in its photograph.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct ViewPlace {
    camera: u32,
    middle: [f32; 2],
    pixel: [f32; 2],
}

impl Vignettes {
    /// Vignettes that start with the coefficients of each camera, or with none where they are not known. `views` has the
    /// number of each view's camera, and the place of its pixels.
    ///
    /// # Panics
    /// When a view's camera has no coefficients, which is a bug in the caller.
    pub fn new(
        start: &[Option<[f32; COEFFICIENTS]>],
        views: impl Iterator<Item = (u32, PhotographPlace)>,
    ) -> Self {
        let camera = |known: &Option<[f32; COEFFICIENTS]>| CameraVignette {
            values: falling(known.unwrap_or_default()),
            start: falling(known.unwrap_or_default()),
            is_known: known.is_some(),
            first: [0.0; COEFFICIENTS],
            second: [0.0; COEFFICIENTS],
            age: 0,
        };
        let views: Vec<ViewPlace> = views
            .map(|(camera, place)| {
                assert!((camera as usize) < start.len(), "camera {camera} has no vignette");
                ViewPlace { camera, middle: place.middle, pixel: place.pixel }
            })
            .collect();
        Self { cameras: start.iter().map(camera).collect(), views }
    }

    /// Memory on the host `[bytes]`, if each view had a camera of its own.
    pub fn bytes(views: usize) -> u64 {
        (views * (size_of::<ViewPlace>() + size_of::<CameraVignette>())) as u64
    }

    /// Number of views.
    pub fn count(&self) -> usize {
        self.views.len()
    }

    /// The vignette of a view of the size of `camera`, which may be smaller than that of its photograph, whose camera
    /// is `whole`.
    pub fn of_view(&self, view: usize, whole: &Camera, camera: &Camera) -> Vignette {
        let ViewPlace { camera: number, mut middle, mut pixel } = self.views[view];
        let ratio = |to: u32, from: u32| (f64::from(to) / f64::from(from)) as f32;
        let ratios = [ratio(camera.width, whole.width), ratio(camera.height, whole.height)];
        for (i, ratio) in ratios.into_iter().enumerate() {
            middle[i] *= ratio;
            pixel[i] /= ratio;
        }
        let coefficients = self.cameras[number as usize].values;
        Vignette { coefficients, place: PhotographPlace { middle, pixel } }
    }

    /// Takes an Adam step for the camera of a view; `progress` is the elapsed fraction of the run. Non-finite gradients
    /// are ignored.
    pub fn step(&mut self, view: usize, gradient: &[f32; COEFFICIENTS], progress: f64) {
        if gradient.iter().any(|number| !number.is_finite()) {
            return;
        }
        let camera = &mut self.cameras[self.views[view].camera as usize];
        let (rate, regularisation) = if camera.is_known {
            (RATE_OF_KNOWN, REGULARISATION_OF_KNOWN)
        } else {
            (RATE, REGULARISATION)
        };
        let rate = (rate * FADE.powf(progress.clamp(0.0, 1.0))) as f32;
        camera.age = camera.age.saturating_add(1);
        let adam = Step::new(camera.age);
        let mut power = 1.0;
        for (i, gradient) in gradient.iter().enumerate() {
            power *= LARGEST;
            let moved = (camera.values[i] - camera.start[i]) * power;
            // The derivative with respect to the coefficient's term at the corner.
            let g = gradient / power + 2.0 * regularisation * moved;
            let step = adam.take(&mut camera.first[i], &mut camera.second[i], g);
            camera.values[i] -= rate * step / power;
        }
        camera.values = falling(camera.values);
    }

    /// Checks that these saved vignettes are finite, and are those of the same views and cameras as `other`.
    ///
    /// # Errors
    /// A description of the mismatch.
    pub fn check_matches(&self, other: &Self) -> Result<(), String> {
        let numbers = |these: &Self| (these.cameras.len(), these.views.len());
        let (found, expected) = (numbers(self), numbers(other));
        if found != expected {
            return Err(format!(
                "its vignettes are for {} cameras with {} views; this run has {} with {}",
                found.0, found.1, expected.0, expected.1
            ));
        }
        if self.views != other.views {
            return Err("its vignettes are for other parts of the photographs".to_owned());
        }
        let numbers = |camera: &CameraVignette| {
            [camera.values, camera.start, camera.first, camera.second].concat()
        };
        if self.cameras.iter().flat_map(numbers).all(f32::is_finite) {
            Ok(())
        } else {
            Err("its vignettes contain a number that is not finite".to_owned())
        }
    }

    /// The light that each camera loses at the corner of a 4:3 photograph `[stops]`.
    pub fn corner_stops(&self) -> impl Iterator<Item = f64> {
        self.cameras.iter().map(|camera| stops(camera.values))
    }
}

fn stops(values: [f32; COEFFICIENTS]) -> f64 {
    let left = light(values, CORNER).clamp(densify_core::vignette::DARKEST, 1.0);
    -f64::from(left).log2()
}

/// The nearest coefficients, by their terms at the corner of a square, with which light falls from the middle to every
/// corner. Otherwise V could rise above 1, where its limit hides all derivatives, or the holes of a model that has just
/// begun could be explained by dark rings.
fn falling(values: [f32; COEFFICIENTS]) -> [f32; COEFFICIENTS] {
    /// Radii at which the slope is limited, and rounds over these limits.
    const RADII: usize = 8;
    const ROUNDS: usize = 100;
    let powers = [1, 2, 3].map(|power| LARGEST.powi(power));
    let mut terms: [f32; COEFFICIENTS] = std::array::from_fn(|i| values[i] * powers[i]);
    // dV/dt, with t the share of the largest r².
    let normal = |i: usize| {
        let t = i as f32 / RADII as f32;
        [1.0, 2.0 * t, 3.0 * t * t]
    };
    let dot =
        |a: &[f32; COEFFICIENTS], b: &[f32; COEFFICIENTS]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    if (0..=RADII).all(|i| dot(&normal(i), &terms) <= 0.0) {
        return values;
    }
    // Hildreth's method finds the nearest point; without the multipliers it would only be some point.
    let mut multipliers = [0.0_f32; RADII + 1];
    for i in (0..ROUNDS).flat_map(|_| 0..=RADII) {
        let normal = normal(i);
        let excess = dot(&normal, &terms) / dot(&normal, &normal);
        let step = excess.max(-multipliers[i]);
        multipliers[i] += step;
        for (term, along) in terms.iter_mut().zip(normal) {
            *term -= step * along;
        }
    }
    let left = (0..=RADII).map(|i| dot(&normal(i), &terms)).fold(0.0, f32::max);
    terms[0] -= left;
    std::array::from_fn(|i| terms[i] / powers[i])
}

/// The cameras with their coefficients, the light that they lose at the corner of a 4:3 photograph, and the names of
/// their views, as JSON.
pub fn named_vignettes<'a>(
    vignettes: &Vignettes,
    names: impl Iterator<Item = &'a str> + Clone,
) -> serde_json::Value {
    let cameras = vignettes.cameras.iter().enumerate().map(|(number, camera)| {
        let own = vignettes.views.iter().zip(names.clone());
        let own = own.filter(|(view, _)| view.camera as usize == number);
        serde_json::json!({
            "coefficients": camera.values,
            "corner_stops": stops(camera.values),
            "views": own.map(|(_, name)| name).collect::<Vec<_>>(),
        })
    });
    serde_json::json!({
        "light": "1 + a r^2 + b r^4 + c r^6 of the linear light is left, with the coefficients a, b, c; r: distance \
                  from the photograph's middle / its longer side",
        "cameras": cameras.collect::<Vec<_>>(),
    })
}

#[cfg(test)]
#[allow(clippy::float_cmp, reason = "exact values")]
mod tests {
    use super::*;
    use glam::{DMat3, DVec3};

    const PLACE: PhotographPlace = PhotographPlace { middle: [20.0, 15.0], pixel: [0.025, 0.025] };

    fn vignettes(start: &[[f32; COEFFICIENTS]], cameras: &[u32]) -> Vignettes {
        let is_known = |values: &&[f32; COEFFICIENTS]| **values != [0.0; COEFFICIENTS];
        let start: Vec<_> =
            start.iter().map(|values| Some(values).filter(is_known).copied()).collect();
        Vignettes::new(&start, cameras.iter().map(|&camera| (camera, PLACE)))
    }

    fn sized(width: u32, height: u32) -> Camera {
        Camera::centred((width, height), (30.0, 30.0), DMat3::IDENTITY, DVec3::ZERO)
    }

    fn values(vignettes: &Vignettes, view: usize) -> [f32; COEFFICIENTS] {
        vignettes.of_view(view, &sized(40, 30), &sized(40, 30)).coefficients
    }

    /// Gradients of half the squared difference of V from that of `to`, at several radii.
    fn towards(to: [f32; COEFFICIENTS], at: [f32; COEFFICIENTS]) -> [f32; COEFFICIENTS] {
        let mut gradient = [0.0; COEFFICIENTS];
        for i in 1..=20 {
            let s = LARGEST * i as f32 / 20.0;
            let error = light(at, s) - light(to, s);
            for (k, gradient) in gradient.iter_mut().enumerate() {
                *gradient += error * s.powi(k as i32 + 1);
            }
        }
        gradient
    }

    #[test]
    fn cameras_learn_their_own_vignettes() {
        let mut found = vignettes(&[[0.0; 3]; 2], &[0, 1, 0]);
        let to = [[-1.2, 0.5, -0.2], [-0.3, 0.0, 0.0]];
        for step in 0..1200 {
            let (view, camera) = [(0, 0), (1, 1), (2, 0)][step % 3];
            let gradient = towards(to[camera], values(&found, view));
            found.step(view, &gradient, step as f64 / 1200.0);
        }
        assert_eq!(values(&found, 0), values(&found, 2), "they share a camera");
        for (view, to) in [(0, to[0]), (1, to[1])] {
            for s in [0.1, 0.3, 0.5] {
                let [a, b] = [light(values(&found, view), s), light(to, s)];
                assert!((a - b).abs() < 0.01, "{view} at {s}: {a} {b}");
            }
        }
        let before = found.clone();
        found.step(0, &[f32::NAN, 0.0, 0.0], 0.5);
        assert_eq!(found, before);
    }

    #[test]
    fn light_falls_from_the_middle_and_darkness_can_be_left() {
        let mut found = vignettes(&[[0.0; 3]], &[0]);
        // Between the radii at which the slope is limited, light may rise a little.
        let is_falling = |values: [f32; COEFFICIENTS]| {
            (0..50).all(|i| {
                let [near, far] = [0.01 * i as f32, 0.01 * (i + 1) as f32];
                light(values, far) <= light(values, near) + 2e-4 && light(values, far) <= 1.0
            })
        };
        let is_dim = |found: &Vignettes| is_falling(values(found, 0));
        assert!(is_dim(&found), "{found:?}");
        for step in 0..300 {
            let gradient = towards([0.8, -1.0, 0.7], values(&found, 0));
            found.step(0, &gradient, f64::from(step) / 300.0);
            assert!(is_dim(&found), "{found:?}");
        }
        // What would be brighter everywhere changes nothing, instead of leaving a dark ring.
        let brighter = falling([0.3, 0.5, 0.7]);
        assert!((1..=5).all(|i| light(brighter, 0.1 * i as f32) > 0.99), "{brighter:?}");
        for raised in [[-0.2, 1.0, -1.5], [-8.7, 9.4, 16.2], [0.4, 0.0, -0.1]] {
            assert!(!is_falling(raised) && is_falling(falling(raised)), "{raised:?}");
        }
        assert_eq!(falling([-0.2, 0.1, 0.05]), [-0.2, 0.1, 0.05]);
        for step in 0..1500 {
            let gradient = towards([-0.8, 0.0, 0.0], values(&found, 0));
            found.step(0, &gradient, f64::from(step) / 1500.0);
        }
        assert!((light(values(&found, 0), 0.5) - 0.6).abs() < 0.01, "{found:?}");
    }

    /// A camera that starts from evidence keeps it where the photographs do not tell, and follows them where they do.
    #[test]
    fn known_vignettes_stay_unless_the_photographs_differ() {
        let start = [-1.2, 0.4, 0.0];
        let mut found = vignettes(&[start], &[0]);
        for step in 0..1000 {
            found.step(0, &[0.0; 3], f64::from(step) / 1000.0);
        }
        assert_eq!(values(&found, 0), start);
        for step in 0..1000 {
            let gradient = towards([-0.9, 0.2, 0.0], values(&found, 0));
            found.step(0, &gradient, f64::from(step) / 1000.0);
        }
        let [at, to] = [values(&found, 0), [-0.9, 0.2, 0.0]].map(|values| light(values, 0.4));
        assert!((at - to).abs() < 0.02 && (at - light(start, 0.4)).abs() > 0.05, "{at} {to}");
    }

    #[test]
    fn smaller_images_have_the_same_radii() {
        let found = vignettes(&[[-1.0, 0.0, 0.0]], &[0]);
        let [whole, half] =
            [sized(40, 30), sized(20, 15)].map(|camera| found.of_view(0, &sized(40, 30), &camera));
        let a = whole.place.squared_radius(31.5, 21.5);
        assert!((a - half.place.squared_radius(15.5, 10.5)).abs() < 1e-6, "{a}");
    }

    #[test]
    fn vignettes_of_another_run_are_refused() {
        let found = vignettes(&[[0.0; 3]; 2], &[0, 1]);
        assert_eq!(found.check_matches(&found), Ok(()));
        let fewer = vignettes(&[[0.0; 3]], &[0, 0]);
        let message = fewer.check_matches(&found).unwrap_err();
        assert!(message.contains("1 cameras") && message.contains("this run has 2"), "{message}");
        let swapped = vignettes(&[[0.0; 3]; 2], &[1, 0]);
        assert!(swapped.check_matches(&found).unwrap_err().contains("other parts"));
        let mut broken = found.clone();
        broken.cameras[1].second[2] = f32::NAN;
        assert!(broken.check_matches(&found).unwrap_err().contains("not finite"));
    }

    #[test]
    fn vignettes_are_read_back_bit_for_bit_and_named() {
        let mut found = vignettes(&[[-1.0 / 3.0, 0.1, 0.0]; 2], &[0, 1, 0]);
        found.step(1, &[0.123_456_7, -0.7, 1e-9], 0.25);
        let text = serde_json::to_string(&found).unwrap();
        assert_eq!(serde_json::from_str::<Vignettes>(&text).unwrap(), found);
        let named = named_vignettes(&found, ["a", "b", "c"].into_iter());
        assert_eq!(named["cameras"][0]["views"], serde_json::json!(["a", "c"]));
        let stops = found.corner_stops().next().unwrap();
        assert_eq!(named["cameras"][0]["corner_stops"], stops);
        assert!(stops > 0.1, "{stops}");
    }
}
