//! Tests of initialisation: scales, colours and numbers of Gaussians, and positions of random points.

use rand_chacha::rand_core::Rng;

use super::*;
use densify_core::camera::Camera;
use densify_core::sh::C0;

fn cloud(positions: &[[f64; 3]]) -> PointCloud {
    PointCloud {
        positions: positions.iter().map(|&p| p.into()).collect(),
        colours: (0..positions.len()).map(|i| [i as u8, 0, 255]).collect(),
    }
}

fn scattered(count: usize, seed: u64) -> PointCloud {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut unit = || (rng.next_u64() >> 11) as f64 / (1u64 << 53) as f64;
    cloud(&(0..count).map(|_| [unit(), 2.0 * unit(), 0.1 * unit()]).collect::<Vec<_>>())
}

/// The index of the point from which each row was created.
fn origins(model: &Gaussians, points: &PointCloud) -> Vec<usize> {
    let origin = |mean: &[f32; 3]| {
        points.positions.iter().position(|p| p.as_vec3().to_array() == *mean).unwrap()
    };
    model.means.iter().map(origin).collect()
}

#[test]
fn rows_follow_a_curve_through_space() {
    let points = scattered(1000, 4);
    let (model, _) = initialise(&points, 1000, 0, 0).unwrap();
    let mut origins = origins(&model, &points);
    let path_length = |order: &[usize]| -> f64 {
        order.windows(2).map(|w| points.positions[w[0]].distance(points.positions[w[1]])).sum()
    };
    origins.dedup();
    let in_order: Vec<usize> = (0..1000).collect();
    assert!(path_length(&origins) < 0.2 * path_length(&in_order));
    origins.sort_unstable();
    assert_eq!(origins, in_order);
}

#[test]
fn scales_agree_with_brute_force() {
    let points = scattered(700, 5);
    let (model, report) = initialise(&points, 10_000, 2, 0).unwrap();
    assert_eq!(report, InitReport { points: 700, rows: 700, ..InitReport::default() });
    for (row, origin) in origins(&model, &points).into_iter().enumerate() {
        let p = &points.positions[origin];
        let mut squares: Vec<f64> =
            points.positions.iter().filter(|q| *q != p).map(|q| q.distance_squared(*p)).collect();
        squares.sort_by(f64::total_cmp);
        let expected = (0.5 * (squares[..3].iter().sum::<f64>() / 3.0).ln()) as f32;
        assert!((model.log_scales[row][0] - expected).abs() < 1e-6, "row {row}");
        assert_eq!(model.log_scales[row], [model.log_scales[row][0]; 3]);
    }
}

#[test]
fn rows_start_as_in_the_original_code() {
    let points = scattered(100, 1);
    let (model, _) = initialise(&points, 1000, 3, 0).unwrap();
    assert_eq!((model.len(), model.sh.len(), model.sh_degree), (100, 100 * 48, 3));
    assert!(model.quats.iter().all(|q| *q == [1.0, 0.0, 0.0, 0.0]));
    for (row, origin) in origins(&model, &points).into_iter().enumerate() {
        assert!((1.0 / (1.0 + (-f64::from(model.opacity_logits[row])).exp()) - 0.1).abs() < 1e-7);
        let sh = model.sh_of(row);
        let expected = [(origin as f64 / 255.0).max(1.0 / 510.0), 1.0 / 510.0, 1.0 - 1.0 / 510.0];
        for channel in 0..3 {
            assert!((0.5 + f64::from(C0 * sh[channel]) - expected[channel]).abs() < 1e-6);
        }
        assert!(sh[3..].iter().all(|&v| v.to_bits() == 0));
    }
}

#[test]
fn one_to_three_points_have_the_expected_scales() {
    let ln = |v: f64| v.ln() as f32;
    let (one, _) = initialise(&cloud(&[[5.0, 0.0, 0.0]]), 9, 0, 0).unwrap();
    assert_eq!(one.log_scales, [[ln(0.01 * SCENE_DIAMETER); 3]]);
    let (two, _) = initialise(&cloud(&[[0.0; 3], [0.0, 0.3, 0.0]]), 9, 0, 0).unwrap();
    assert!(two.log_scales.iter().all(|log| (log[0] - ln(0.3)).abs() < 1e-6));
    let (three, _) =
        initialise(&cloud(&[[0.0; 3], [0.0, 0.3, 0.0], [0.4, 0.0, 0.0]]), 9, 0, 0).unwrap();
    assert!((three.log_scales[0][0] - ln((0.25f64 / 2.0).sqrt())).abs() < 1e-6);
    let (close, _) = initialise(&cloud(&[[0.0; 3], [0.0, 1e-30, 0.0]]), 9, 0, 0).unwrap();
    assert!((close.log_scales[0][0] - ln(1e-4 * SCENE_DIAMETER)).abs() < 1e-6);
}

#[test]
fn duplicate_and_non_finite_points_are_dropped_and_counted() {
    let mut points = scattered(50, 2);
    let alone = initialise(&points, 1000, 0, 0).unwrap().0;
    for _ in 0..300 {
        points.positions.push(points.positions[7]);
        points.colours.push([1, 2, 3]);
    }
    points.positions.push(DVec3::new(f64::NAN, 0.0, 0.0));
    points.positions.push(DVec3::new(0.0, 1e39, 0.0));
    points.colours.extend([[0; 3]; 2]);
    let (model, report) = initialise(&points, 1000, 0, 0).unwrap();
    assert_eq!(
        report,
        InitReport { points: 352, duplicates: 300, unusable: 2, over_budget: 0, rows: 50 }
    );
    assert_eq!(model, alone);
    let same = cloud(&[[1.0, 2.0, 3.0]; 1000]);
    assert_eq!(initialise(&same, 1000, 0, 0).unwrap().0.len(), 1);
    // On a line all coordinates but one are equal.
    let line = cloud(&(0..1000).map(|i| [0.0, f64::from(i), 0.0]).collect::<Vec<_>>());
    assert_eq!(initialise(&line, 1000, 0, 0).unwrap().0.len(), 1000);
}

#[test]
fn the_budget_is_kept_by_a_seeded_subsample() {
    let points = scattered(1000, 3);
    let (a, report) = initialise(&points, 300, 1, 7).unwrap();
    assert_eq!(
        report,
        InitReport { points: 1000, over_budget: 700, rows: 300, ..InitReport::default() }
    );
    assert_eq!(a.len(), 300);
    assert_eq!(a, initialise(&points, 300, 1, 7).unwrap().0);
    assert_ne!(a.means, initialise(&points, 300, 1, 8).unwrap().0.means);
    // The subset comes from all parts of the cloud, not only from the first points.
    let late = origins(&a, &points).iter().filter(|&&i| i >= 500).count();
    assert!((110..190).contains(&late), "{late} of 300 from the second half");
}

#[test]
fn impossible_requests_are_errors() {
    let points = scattered(10, 1);
    let none = PointCloud::default();
    for (points, budget, degree, error) in [
        (&points, 0, 0, InitError::NoBudget),
        (&points, 1, 4, InitError::Degree(4)),
        (&none, 1, 0, InitError::NoPoints),
    ] {
        assert_eq!(initialise(points, budget, degree, 0).unwrap_err(), error);
    }
}

/// Cameras on a circle of radius 1, looking in the direction that `direction` returns for their position.
fn ring(direction: impl Fn(DVec3) -> DVec3) -> Vec<Camera> {
    let camera = |i: u32| {
        let angle = std::f64::consts::TAU * f64::from(i) / 12.0;
        let centre = DVec3::new(angle.cos(), 0.0, angle.sin());
        let z = direction(centre).normalize();
        let x = DVec3::Y.cross(z).normalize();
        let rotation = glam::DMat3::from_cols(x, z.cross(x), z).transpose();
        Camera::centred((100, 100), (100.0, 100.0), rotation, centre)
    };
    (0..12).map(camera).collect()
}

#[test]
fn random_points_are_where_cameras_look() {
    let target = DVec3::new(0.1, 0.2, -0.1);
    let inward = ring(|c| target - c);
    let points = random_points(500, &inward, false, 4);
    assert_eq!(points, random_points(500, &inward, false, 4));
    assert_ne!(points, random_points(500, &inward, false, 5));
    let reach =
        points.positions.iter().map(|p| (*p - target).abs().max_element()).fold(0.0, f64::max);
    assert!((0.3..0.4).contains(&reach), "{reach}");

    let in_view = |cameras: &[Camera], p: DVec3| {
        cameras.iter().any(|camera| {
            let (pixel, depth) = camera.project(p);
            depth > 0.2
                && pixel.cmpge(glam::DVec2::splat(-0.01)).all()
                && pixel.cmple(glam::DVec2::splat(100.01)).all()
        })
    };
    let outward = ring(|c| c);
    let parallel = ring(|_| DVec3::X);
    for cameras in [&outward, &parallel] {
        let points = random_points(500, cameras, true, 4);
        assert!(points.positions.iter().all(|&p| in_view(cameras, p)));
    }
    let far = random_points(500, &inward, true, 4)
        .positions
        .iter()
        .filter(|p| (**p - target).length() > 0.6)
        .count();
    assert!((75..=250).contains(&far), "{far} of 500 points are in the background");
    assert_eq!(random_points(10, &[], true, 0).len(), 10);
    assert_eq!(random_points(10, &inward[..1], true, 0).len(), 10);
}

#[test]
fn policies_may_change_the_initial_opacity_and_scale() {
    let mut model = Gaussians {
        log_scales: vec![[0.0, 1.0, -2.0]; 2],
        opacity_logits: vec![-3.0, 2.0],
        ..Gaussians::default()
    };
    let before = model.clone();
    apply_start_rule(&mut model, &StartRule::default());
    assert_eq!(model, before);
    apply_start_rule(&mut model, &StartRule { opacity: Some(0.5), scale: 0.1 });
    assert_eq!(model.opacity_logits, [0.0, 0.0]);
    let tenth = 0.1_f32.ln();
    assert_eq!(model.log_scales[1], [tenth, 1.0 + tenth, -2.0 + tenth]);
}

#[test]
#[ignore = "needs real photographs: set DENSIFY_SHARED"]
fn real_points_of_shared_datasets_become_rows() {
    use densify_data::dataset::{Dataset, LoadOptions};
    for name in ["room256", "cup", "office", "beercan"] {
        let data = Dataset::load(&densify_fixtures::shared(name), &LoadOptions::default()).unwrap();
        let (model, report) = initialise(&data.points, 4000, 3, 0).unwrap();
        assert_eq!((model.len(), report.rows), (4000, 4000), "{name}");
        assert!(model.log_scales.iter().all(|log| log[0] > -12.0 && log[0] < 5.0), "{name}");
    }
}
