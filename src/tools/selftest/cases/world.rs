//! The same scene far from the origin, tiny, huge, and with exchanged axes.

use glam::{DMat3, DVec3};

use crate::trial::Trial;
use densify_core::camera::Camera;
use densify_data::dataset::PointCloud;
use densify_data::dataset::normalise::Normalisation;
use densify_render::BackendError;
use densify_train::init::initialise;

/// Cameras that look at a point cloud, in world coordinates.
fn rig() -> (Vec<Camera>, Vec<DVec3>) {
    let cameras = (0..5_u8).map(|i| {
        let rotation = DMat3::from_rotation_y(1.2566 * f64::from(i)) * DMat3::from_rotation_x(0.2);
        Camera {
            width: 64,
            height: 48,
            fx: 60.0,
            fy: 62.0,
            cx: 31.0,
            cy: 25.0,
            rotation,
            translation: DVec3::new(0.1, -0.2, 3.0),
        }
    });
    let points = (0..80_u8).map(|i| {
        let t = f64::from(i);
        DVec3::new((t * 0.7).sin(), 0.8 * (t * 1.3).sin(), (t * 2.1).cos())
    });
    (cameras.collect(), points.collect())
}

/// Renders the first camera's view after the world is rotated by `turn` and then shifted or scaled by `place`.
fn render_placed(
    trial: &Trial<'_>,
    turn: DMat3,
    place: impl Fn(DVec3) -> DVec3,
) -> Result<Vec<f32>, BackendError> {
    let (cameras, points) = rig();
    let cameras: Vec<Camera> = cameras
        .iter()
        .map(|camera| {
            let rotation = camera.rotation * turn.transpose();
            let centre = place(turn * camera.centre());
            Camera { rotation, translation: -(rotation * centre), ..*camera }
        })
        .collect();
    let points: Vec<DVec3> = points.iter().map(|p| place(turn * *p)).collect();
    let centres: Vec<DVec3> = cameras.iter().map(Camera::centre).collect();
    let normalisation = Normalisation::fit(&centres, &points);
    let colours = (0..points.len()).map(|i| [i as u8, 3 * i as u8, 255 - i as u8]).collect();
    let positions = points.iter().map(|p| normalisation.scene_from_world(*p)).collect();
    let (mut model, _) =
        initialise(&PointCloud { positions, colours }, 100, 0, 1).expect("a sound point cloud");
    model.opacity_logits.fill(0.5);
    let camera = normalisation.scene_from_world_camera(&cameras[0]);
    Ok(trial.subject.backend(&model)?.render(&camera, [0.1; 3], 0)?.rgb)
}

fn rms(a: &[f32], b: &[f32]) -> f64 {
    let sum: f64 = a.iter().zip(b).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum();
    (sum / a.len() as f64).sqrt()
}

pub(super) fn placements(trial: &mut Trial<'_>) -> Result<(), BackendError> {
    let base = render_placed(trial, DMat3::IDENTITY, |p| p)?;
    let away = DVec3::new(1.0, -0.7, 0.3);
    for offset in [1e3, 1e5, 1e6, 5e6, 1e8] {
        let moved = render_placed(trial, DMat3::IDENTITY, |p| p + offset * away)?;
        // 3.2e-5 is 90 dB.
        trial.record(&format!("offset {offset:e}"), "rms of colours", rms(&moved, &base), 3.2e-5);
    }
    for scale in [1e-4, 1e4] {
        let moved = render_placed(trial, DMat3::IDENTITY, |p| p * scale)?;
        trial.record(&format!("scale {scale:e}"), "rms of colours", rms(&moved, &base), 3.2e-5);
    }
    for power in [-20, -1, 7, 20] {
        let moved = render_placed(trial, DMat3::IDENTITY, |p| p * 2.0_f64.powi(power))?;
        let different = moved.iter().zip(&base).filter(|(a, b)| a.to_bits() != b.to_bits()).count();
        trial.count(&format!("scale 2^{power}"), "bits that differ", different);
    }
    for (label, turn) in [
        ("yzx", DMat3::from_cols(DVec3::Y, DVec3::Z, DVec3::X)),
        ("zxy", DMat3::from_cols(DVec3::Z, DVec3::X, DVec3::Y)),
    ] {
        let moved = render_placed(trial, turn, |p| p)?;
        // 1e-5 is 100 dB: the sums of three products are added in another order.
        let label = format!("axes {label}");
        trial.record(&label, "rms of colours, exchanged axes", rms(&moved, &base), 1e-5);
    }
    Ok(())
}
