//! Tests of lenses: projection compared with COLMAP's, round trips, and the pinholes that replace lenses.

use glam::{DVec2, DVec3};

use super::models::{LensModel, MODELS};
use super::{Distortion, Lens, PinholeError, Pinholes, Projection, Unseen};
use densify_core::image::Image8;

const SIZE: (u32, u32) = (300, 184);

/// A lens of a model, from parameters in COLMAP's order.
fn lens(name: &str, parameters: &[f64]) -> Lens {
    let model: &LensModel = MODELS.iter().find(|model| model.name == name).unwrap();
    let mut next = parameters.iter().copied();
    let mut next = || next.next().unwrap();
    let fx = next();
    let fy = if model.focals == 2 { next() } else { fx };
    let principal = DVec2::new(next(), next());
    let mut distortion = Distortion::none(model.plane);
    for &term in model.terms {
        distortion.set(term, next());
    }
    Lens::new(SIZE, DVec2::new(fx, fy), principal, distortion)
}

/// Rays, in the order of the references below.
const RAYS: [DVec3; 3] =
    [DVec3::new(0.1, -0.2, 1.0), DVec3::new(-0.7, 0.4, 1.0), DVec3::new(1.1, 0.6, 0.8)];

/// Model, parameters, and projections of the rays by COLMAP 4.2.1 (`pycolmap.Camera.img_from_cam`).
type Reference = (&'static str, &'static [f64], [[f64; 2]; 3]);

const REFERENCES: [Reference; 7] = [
    (
        "FULL_OPENCV",
        &[210.0, 214.0, 150.0, 92.0, 0.12, -0.05, 0.001, -0.002, 0.01, 0.08, -0.02, 0.003],
        [
            [171.00248423715664, 49.16283688808073],
            [0.051668065207991276, 179.29698036474966],
            [441.9592188694694, 255.38148748523747],
        ],
    ),
    (
        "OPENCV_FISHEYE",
        &[120.0, 122.0, 150.0, 92.0, 0.03, -0.008, 0.002, -0.0003],
        [
            [161.82271531840001, 67.96047885258662],
            [78.43557320996325, 133.57552413516422],
            [258.13153325558585, 151.9638502599158],
        ],
    ),
    (
        "SIMPLE_RADIAL_FISHEYE",
        &[120.0, 150.0, 92.0, -0.02],
        [
            [161.79436696121905, 68.4112660775619],
            [79.95592817497113, 132.0251839000165],
            [253.49494174508257, 148.45178640640867],
        ],
    ),
    (
        "RADIAL_FISHEYE",
        &[120.0, 150.0, 92.0, -0.02, 0.003],
        [
            [161.79444991042487, 68.41110017915022],
            [79.91097346905882, 132.05087230339495],
            [253.8150656717226, 148.62639945730325],
        ],
    ),
    (
        "THIN_PRISM_FISHEYE",
        &[
            120.0, 122.0, 150.0, 92.0, 0.02, -0.005, 0.0008, -0.0005, 0.001, -0.0001, 0.0006,
            -0.0004,
        ],
        [
            [161.81278611253302, 67.98421073063608],
            [78.64815822730807, 133.4776993636125],
            [257.3045756102932, 151.5476269879187],
        ],
    ),
    (
        "FOV",
        &[180.0, 182.0, 150.0, 92.0, 0.9],
        [
            [169.02976939130872, 53.51757745313128],
            [35.089093700622726, 158.39296808408466],
            [323.26501796426226, 187.5582826348355],
        ],
    ),
    (
        "OPENCV",
        &[210.0, 214.0, 150.0, 92.0, 0.058, -0.08, -9.8e-4, 1.6e-4],
        [
            [171.067284, 49.0558068],
            [2.5967159999999865, 177.71123720000003],
            [340.6070291015625, 197.387518359375],
        ],
    ),
];

#[test]
fn rays_project_where_colmap_projects_them() {
    for (name, parameters, places) in REFERENCES {
        let lens = lens(name, parameters);
        for (ray, place) in RAYS.into_iter().zip(places) {
            let found = lens.extrapolate(ray).unwrap();
            assert!(found.distance(place.into()) < 1e-9, "{name} {ray}: {found}, not {place:?}");
        }
    }
}

/// The lenses above, and lenses of each kind with a stronger distortion.
fn lenses() -> Vec<(&'static str, Lens)> {
    let mut all: Vec<_> = REFERENCES.iter().map(|(name, p, _)| (*name, lens(name, p))).collect();
    let opencv = |k: [f64; 4]| lens("OPENCV", &[&[210.0, 214.0, 150.0, 92.0], &k[..]].concat());
    all.extend([
        ("barrel", opencv([-0.12, 0.02, 0.0, 0.0])),
        ("pincushion", opencv([0.3, 0.0, 2e-3, -3e-3])),
        ("tangential", opencv([0.0, 0.0, 0.0, 1e-3])),
        // A field of view of 204 by 125 degrees, and of 239 from corner to corner.
        ("wide", lens("OPENCV_FISHEYE", &[85.0, 85.0, 151.0, 93.0, 0.01, -0.002, 0.0, 0.0])),
        ("circle", lens("SIMPLE_RADIAL_FISHEYE", &[95.0, 150.0, 92.0, -0.01])),
        ("tango", lens("FOV", &[120.0, 121.0, 150.0, 92.0, 1.2])),
    ]);
    all
}

#[test]
fn every_lens_model_round_trips_a_grid() {
    for (name, lens) in lenses() {
        let (mut tried, mut worst) = (0, 0.0_f64);
        for (x, y) in (0..=60).flat_map(|x| (0..=40).map(move |y| (x, y))) {
            let pixel = lens.size() * DVec2::new(f64::from(x) / 60.0, f64::from(y) / 40.0);
            let Ok(ray) = lens.unproject(pixel) else { continue };
            tried += 1;
            let back = lens.project(ray).unwrap_or(DVec2::INFINITY);
            worst = worst.max(back.distance(pixel));
        }
        // From rays to pixels and back, over the invertible field of view: only rounding errors remain.
        let half = 0.5 * lens.usable_field().to_radians();
        for (i, j) in (0..=80).flat_map(|i| (0..48).map(move |j| (i, j))) {
            let angle = half * f64::from(i) / 80.001;
            let turn = DVec2::from_angle(std::f64::consts::TAU * f64::from(j) / 48.0);
            let ray = (turn * angle.sin()).extend(angle.cos());
            let Some(pixel) = lens.project(ray) else { panic!("{name}: {ray} is not imaged") };
            let back = lens.unproject(pixel).unwrap_or_else(|e| panic!("{name}: {ray}: {e:?}"));
            let again = lens.project(back).unwrap_or(DVec2::INFINITY);
            worst = worst.max(again.distance(pixel));
            assert!(back.normalize().distance(ray) < 1e-8, "{name}: {ray} became {back}");
        }
        assert!(tried > 1500 && worst < 1e-6, "{name}: {tried} pixels, {worst} px");
    }
}

#[test]
fn folding_and_too_wide_lenses_are_not_inverted() {
    let folding = lens("OPENCV", &[210.0, 214.0, 150.0, 92.0, -1.0, 0.0, 0.0, 0.0]);
    // r − r³ folds over at r = 0.577, 30 degrees from the axis: the usable field of view is 60 degrees.
    assert!((folding.usable_field() - 60.0).abs() < 0.2, "{}", folding.usable_field());
    assert_eq!(folding.unproject(DVec2::ZERO), Err(Unseen::Folds));
    assert_eq!(folding.project(DVec3::new(0.6, 0.0, 1.0)), None);
    let wide = lens("OPENCV_FISHEYE", &[40.0, 40.0, 150.0, 92.0, 0.0, 0.0, 0.0, 0.0]);
    assert_eq!(wide.unproject(DVec2::ZERO), Err(Unseen::TooWide));
    for bad in [f64::NAN, f64::INFINITY] {
        let lens = lens("OPENCV", &[210.0, 214.0, 150.0, 92.0, bad, 0.0, 0.0, 0.0]);
        assert!(!lens.is_finite() && lens.unproject(DVec2::ZERO).is_err());
    }
}

#[test]
fn a_pinhole_sees_only_what_the_lens_saw_and_reaches_every_side_of_the_photograph() {
    for (name, lens) in lenses() {
        let pinholes = Pinholes::covering(&lens, false).unwrap();
        for (face, undistortion) in &pinholes.faces {
            let to = undistortion.to;
            let size = DVec2::new(f64::from(to.width), f64::from(to.height));
            let mut slack = [f64::INFINITY; 4];
            for (i, side) in (0..=500).flat_map(|i| (0..4).map(move |side| (i, side))) {
                let at = f64::from(i) / 500.0;
                let at = [(at, 0.0), (at, 1.0), (0.0, at), (1.0, at)][side];
                let s = undistortion.source_of(size * DVec2::from(at)).unwrap();
                let inside = [s.x, s.y, 300.0 - s.x, 184.0 - s.y];
                assert!(inside.iter().all(|&d| d > -0.02), "{name} {face} at {at:?}: {s}");
                slack = std::array::from_fn(|side| slack[side].min(inside[side]));
            }
            if pinholes.faces.len() == 1 {
                assert!(slack.iter().all(|&d| d < 1.5), "{name}: a side could be wider: {slack:?}");
            }
            assert!(!undistortion.masked, "{name} {face}");
        }
    }
}

/// Faces do not overlap: a ray falls into exactly one of them, except on common edges.
#[test]
fn a_wide_field_of_view_becomes_faces_of_a_cube() {
    for (name, expected) in [
        ("wide", &["front", "left", "right", "up", "down"][..]),
        ("OPENCV_FISHEYE", &["front", "left", "right"]),
        ("barrel", &[""]),
    ] {
        let lens = lenses().into_iter().find(|(other, _)| *other == name).unwrap().1;
        let [cropped, kept] = [false, true].map(|keep| Pinholes::covering(&lens, keep).unwrap());
        let names: Vec<_> = cropped.faces.iter().map(|(name, _)| *name).collect();
        assert_eq!(names, expected, "{name}");
        assert!(kept.cropped <= 0.001 && cropped.cropped > kept.cropped, "{name}");
        assert!(kept.faces.iter().any(|(_, face)| face.masked), "{name}");
        let (mut none, mut several) = (0, 0);
        for (x, y) in (1..60).flat_map(|x| (1..37).map(move |y| (x, y))) {
            let ray = lens.unproject(5.0 * DVec2::new(f64::from(x), f64::from(y)) - 0.7).unwrap();
            let shown = kept.faces.iter().filter(|(_, face)| face.shows(ray)).count();
            none += usize::from(shown == 0);
            several += usize::from(shown > 1);
        }
        assert_eq!((none, several), (0, 0), "{name}");
    }
}

#[test]
fn a_distortion_that_folds_over_is_refused_or_used_up_to_the_fold() {
    for k in [[-1.5, 0.0, 0.0, 0.0], [0.0, -4.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]] {
        let lens = lens("OPENCV", &[&[210.0, 214.0, 150.0, 92.0], &k[..]].concat());
        let Err(PinholeError::Folds(degrees)) = Pinholes::covering(&lens, false) else {
            panic!("{k:?}")
        };
        assert!((degrees - lens.usable_field()).abs() < 1e-9 && degrees > 1.0, "{k:?}: {degrees}");
        let Pinholes { faces, cropped } = Pinholes::covering(&lens, true).unwrap();
        assert!(faces.len() == 1 && faces[0].1.masked && cropped > 0.01, "{k:?}");
    }
    let nan = lens("OPENCV", &[210.0, 214.0, 150.0, 92.0, f64::NAN, 0.0, 0.0, 0.0]);
    assert!(
        Pinholes::covering(&nan, false).is_err()
            && Pinholes::covering(&nan, true) == Err(PinholeError::NothingVisible)
    );
    // An image that does not contain the optical axis, such as a crop, is still usable.
    let aside = lens("OPENCV", &[210.0, 214.0, -40.0, 92.0, 0.058, 0.0, 0.0, 0.0]);
    let pinholes = Pinholes::covering(&aside, false).unwrap();
    assert!(pinholes.faces.len() == 1 && pinholes.cropped < 0.15, "{pinholes:?}");
}

/// After undistortion, dots that were drawn at the lens's projections of known rays lie at the pinhole's projections of
/// these rays.
#[test]
fn undistorted_dots_lie_where_pinholes_project_them() {
    for (name, lens) in lenses() {
        let (width, height) = SIZE;
        let centre = |index: usize, width: u32| {
            let row = width as usize;
            DVec2::new((index % row) as f64 + 0.5, (index / row) as f64 + 0.5)
        };
        let mut rays = Vec::new();
        let mut rgb = vec![0; (width * height * 3) as usize];
        for (i, j) in (0..7).flat_map(|i| (0..5).map(move |j| (i, j))) {
            let dot = DVec2::new(33.0 + 39.0 * f64::from(i), 20.0 + 36.0 * f64::from(j));
            rays.push(lens.unproject(dot).unwrap());
            for (index, rgb) in rgb.chunks_exact_mut(3).enumerate() {
                let off = (centre(index, width) - dot).length_squared();
                let value = 255.0 * (-off / (2.0 * 1.5 * 1.5)).exp();
                rgb.fill(rgb[0].max(value.round() as u8));
            }
        }
        let image = Image8 { width, height, rgb, alpha: None, mask: None };
        let mut found = 0;
        for (face, undistortion) in Pinholes::covering(&lens, true).unwrap().faces {
            let (out, to) = (undistortion.apply(&image), undistortion.to);
            let size = DVec2::new(f64::from(to.width), f64::from(to.height));
            assert_eq!(out.mask.is_some(), undistortion.masked);
            for ray in &rays {
                let ray = undistortion.lens_from_pinhole.transpose() * *ray;
                let pixel = ray.truncate() / ray.z * to.focal + to.principal;
                let near = pixel.cmpgt(DVec2::splat(9.0)) & pixel.cmplt(size - 9.0);
                // Far from the axis, undistortion stretches a dot, which moves its centre of mass.
                if ray.z < 0.75 * ray.length() || !near.all() {
                    continue;
                }
                let (mut sum, mut moment) = (0.0, DVec2::ZERO);
                for (index, rgb) in out.rgb.chunks_exact(3).enumerate() {
                    let at = centre(index, to.width);
                    if (at - pixel).length() < 8.0 {
                        sum += f64::from(rgb[0]);
                        moment += at * f64::from(rgb[0]);
                    }
                }
                let error = (moment / sum - pixel).length();
                assert!(error < 0.2, "{name} {face}: the dot at {pixel} is off by {error} px");
                found += 1;
            }
        }
        assert!(found >= 12, "{name}: {found} dots");
    }
}

#[test]
fn a_projection_and_its_inverse_agree() {
    use Projection::{Equidistant, Fov, Perspective};
    for plane in [Perspective, Equidistant, Fov(0.9), Fov(-1.4)] {
        for i in 1..100 {
            let angle = plane.widest() * f64::from(i) / 100.0;
            assert!((plane.angle(plane.radius(angle)) - angle).abs() < 1e-12, "{plane:?} {angle}");
        }
        assert!((plane.radius(1e-6) / 1e-6 - plane.slope()).abs() < 1e-9, "{plane:?}");
    }
}
