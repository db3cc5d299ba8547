//! Writes COLMAP's text model under `sparse/0`; image names are relative to `images`.
//!
//! Features are the exact projections of true surface points; only the 3D points have noise or are outliers.
//! Reprojection errors therefore come from the 3D points alone.

use std::fmt::Write as _;
use std::path::Path;

use glam::DQuat;

use super::write_file;
use crate::error::Error;
use crate::lens::{Lens, LensKind};
use crate::points::InitPoints;
use crate::scene::Scene;

pub(super) fn write(scene: &Scene, root: &Path, points: &InitPoints) -> Result<(), Error> {
    let folder = root.join("sparse").join("0");
    let mut cameras = String::from("# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n");
    let mut images = String::from(
        "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n# POINTS2D[] as (X, Y, POINT3D_ID)\n",
    );
    // The points that each view sees; and each point's track: the views that see it, with its feature's index in each.
    let mut seen: Vec<Vec<usize>> = vec![Vec::new(); scene.views.len()];
    let mut tracks: Vec<Vec<(usize, usize)>> = vec![Vec::new(); points.positions.len()];
    for (point, views) in points.seen_by.iter().enumerate() {
        for &view in views {
            let list = &mut seen[view as usize];
            tracks[point].push((view as usize, list.len()));
            list.push(point);
        }
    }
    for (number, view) in scene.views.iter().enumerate() {
        let (id, c) = (number + 1, scene.written_camera(number));
        let (model, rest) = model(c.lens.as_ref());
        // Writing to a String does not fail.
        let _ = writeln!(
            cameras,
            "{id} {model} {} {} {} {} {} {}{rest}",
            c.width, c.height, c.fx, c.fy, c.cx, c.cy
        );
        // Features are where the image shows them, whatever the pose says.
        let rotation = c.world_from_camera.transpose();
        let q = DQuat::from_mat3(&rotation).normalize();
        let t = -(rotation * c.centre);
        let _ = writeln!(
            images,
            "{id} {} {} {} {} {} {} {} {id} {}.png",
            q.w, q.x, q.y, q.z, t.x, t.y, t.z, view.name
        );
        let observations = seen[number].iter().map(|&point| {
            let (pixel, _) = view.camera.project(points.found_at[point]);
            format!("{} {} {}", pixel.x, pixel.y, point + 1)
        });
        images += &observations.collect::<Vec<_>>().join(" ");
        images.push('\n');
    }
    let mut cloud =
        String::from("# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n");
    for (point, (p, [r, g, b])) in points.positions.iter().zip(&points.colours).enumerate() {
        let error = reprojection_error(scene, points, point);
        let _ = write!(cloud, "{} {} {} {} {r} {g} {b} {error}", point + 1, p.x, p.y, p.z);
        for (view, feature) in &tracks[point] {
            let _ = write!(cloud, " {} {feature}", view + 1);
        }
        cloud.push('\n');
    }
    write_file(&folder.join("cameras.txt"), cameras.as_bytes())?;
    write_file(&folder.join("images.txt"), images.as_bytes())?;
    write_file(&folder.join("points3D.txt"), cloud.as_bytes())
}

/// COLMAP's camera model of a lens, and its parameters after those of a pinhole.
fn model(lens: Option<&Lens>) -> (&'static str, String) {
    let Some(Lens { kind, k: [a, b, c, d] }) = lens else { return ("PINHOLE", String::new()) };
    match kind {
        LensKind::Fisheye => ("OPENCV_FISHEYE", format!(" {a} {b} {c} {d}")),
        LensKind::Radial => ("OPENCV", format!(" {a} {b} 0 0")),
    }
}

/// Mean distance between a point's features and its projections over the views that see it `[px]`; -1, as in
/// COLMAP, if there are none.
fn reprojection_error(scene: &Scene, points: &InitPoints, point: usize) -> f64 {
    let views = &points.seen_by[point];
    let error = |&view: &u32| {
        let camera = &scene.views[view as usize].camera;
        let [feature, projection] =
            [&points.found_at, &points.positions].map(|p| camera.project(p[point]).0);
        feature.distance(projection)
    };
    if views.is_empty() {
        return -1.0;
    }
    views.iter().map(error).sum::<f64>() / views.len() as f64
}
