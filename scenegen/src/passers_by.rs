//! People who walk through the scene while it is photographed: figures of ellipsoids between camera and scene,
//! in a different position in each view, with a mask of the pixels they cover.

use glam::{DVec2, DVec3, Vec3};

use crate::camera::Camera;
use crate::camera_light::CameraLight;
use crate::random::Draws;
use crate::texture::encode;
use crate::trace::Frame;

/// Key of the random stream.
const STREAM: u64 = 0x7061_7373_6572_7300;
/// Number of rays along each side of a pixel.
const GRID: u32 = 3;
/// Direction towards the light, in camera axes.
const LIGHT: DVec3 = DVec3::new(-0.48, -0.64, -0.6);

/// An ellipsoid aligned with the camera's axes, in camera coordinates.
struct Part {
    centre: DVec3,
    /// Semi-axes.
    axes: DVec3,
    colour: Vec3,
}

/// Selects the views with passers-by at random: a share of all `views`, rounded to a whole number.
pub(crate) fn select_views(seed: u64, views: usize, share: f64) -> Vec<bool> {
    let mut order: Vec<usize> = (0..views).collect();
    order.sort_by_key(|&view| (Draws::new(seed, &[STREAM, view as u64, 1]).bits(), view));
    let mut chosen = vec![false; views];
    for &view in &order[..((share * views as f64).round() as usize).min(views)] {
        chosen[view] = true;
    }
    chosen
}

/// Draws one or two figures into the photograph of a view and into its mask.
pub(crate) fn draw(
    frame: &mut Frame,
    camera: &Camera,
    seed: u64,
    view: usize,
    light: Option<CameraLight>,
) {
    let mut draws = Draws::new(seed, &[STREAM, view as u64, 2]);
    let Some(depth) = median_depth(frame) else { return };
    let count = 1 + draws.bits() % 2;
    let parts: Vec<Part> = (0..count).flat_map(|_| figure(camera, depth, &mut draws)).collect();
    let mut photograph = frame.exposed.take().unwrap_or_else(|| frame.rgba.clone());
    let mut mask = vec![255; frame.depth.len()];
    let width = frame.width as usize;
    for (at, (pixel, mask)) in
        photograph.as_chunks_mut::<4>().0.iter_mut().zip(&mut mask).enumerate()
    {
        let corner = DVec2::new((at % width) as f64, (at / width) as f64);
        let scene_depth = match frame.depth[at] {
            0.0 => f64::INFINITY,
            depth => f64::from(depth),
        };
        let (colour, cover) = trace(&parts, camera, corner, scene_depth);
        if cover > 0.0 {
            *mask = 0;
            let size = [frame.width, frame.height];
            let factors = light.map_or(Vec3::ONE, |light| light.at(corner + 0.5, size));
            *pixel = over(colour * factors / cover, cover, *pixel);
        }
    }
    frame.exposed = Some(photograph);
    frame.mask = Some(mask);
}

/// The median depth of a view; `None` if the view is empty.
fn median_depth(frame: &Frame) -> Option<f64> {
    let mut depths: Vec<f32> = frame.depth.iter().copied().filter(|&depth| depth > 0.0).collect();
    let middle = depths.len() / 2;
    (!depths.is_empty())
        .then(|| f64::from(*depths.select_nth_unstable_by(middle, f32::total_cmp).1))
}

/// A figure of one to two thirds of the image's height, well in front of the scene.
fn figure(camera: &Camera, depth: f64, draws: &mut Draws) -> [Part; 4] {
    let mut between = |low: f64, high: f64| low + (high - low) * draws.unit64();
    let distance = depth * between(0.35, 0.65);
    let height = between(0.35, 0.65) * f64::from(camera.height) / camera.fy * distance;
    let middle = DVec2::new(
        between(0.15, 0.85) * f64::from(camera.width) - camera.cx,
        between(0.4, 0.6) * f64::from(camera.height) - camera.cy,
    ) / DVec2::new(camera.fx, camera.fy);
    let centre = (distance * middle).extend(distance);
    let mut colour = || {
        Vec3::new(between(0.02, 0.6) as f32, between(0.02, 0.6) as f32, between(0.02, 0.6) as f32)
    };
    let (coat, trousers) = (colour(), colour());
    let part = |x: f64, y: f64, axes: [f64; 3], colour: Vec3| Part {
        centre: centre + height * DVec3::new(x, y, 0.0),
        axes: height * DVec3::from(axes),
        colour,
    };
    [
        part(0.0, -0.4, [0.09, 0.1, 0.09], Vec3::new(0.55, 0.33, 0.24)),
        part(0.0, -0.1, [0.15, 0.24, 0.1], coat),
        part(-0.07, 0.28, [0.07, 0.22, 0.07], trousers),
        part(0.07, 0.28, [0.07, 0.22, 0.07], trousers),
    ]
}

/// Traces the figures that are nearer than `scene_depth` in a pixel: their radiance times coverage, and their coverage.
fn trace(parts: &[Part], camera: &Camera, corner: DVec2, scene_depth: f64) -> (Vec3, f32) {
    let axes = camera.world_from_camera.transpose();
    let (mut sum, mut hits) = (Vec3::ZERO, 0);
    for ray in 0..GRID * GRID {
        let offset = DVec2::new(f64::from(ray % GRID), f64::from(ray / GRID)) + 0.5;
        let direction = axes * camera.direction(corner + offset / f64::from(GRID));
        let first = parts.iter().filter_map(|part| {
            let (scaled, centre) = (direction / part.axes, part.centre / part.axes);
            let (a, b) = (scaled.length_squared(), scaled.dot(centre));
            let root = b * b - a * (centre.length_squared() - 1.0);
            let depth = (b - root.max(0.0).sqrt()) / a;
            (root > 0.0 && depth > 0.0 && depth < scene_depth).then_some((depth, part))
        });
        if let Some((depth, part)) = first.min_by(|a, b| a.0.total_cmp(&b.0)) {
            let normal = ((depth * direction - part.centre) / (part.axes * part.axes)).normalize();
            sum += part.colour * (0.35 + 0.65 * normal.dot(LIGHT).max(0.0)) as f32;
            hits += 1;
        }
    }
    let share = 1.0 / (GRID * GRID) as f32;
    (sum * share, hits as f32 * share)
}

/// Blends linear light that covers a share of a pixel over the pixel behind it.
fn over(light: Vec3, cover: f32, behind: [u8; 4]) -> [u8; 4] {
    let rest = (1.0 - cover) * f32::from(behind[3]) / 255.0;
    let alpha = cover + rest;
    let mix = |light: f32, behind: u8| {
        ((cover * f32::from(encode(light)) + rest * f32::from(behind)) / alpha + 0.5) as u8
    };
    let [r, g, b, _] = behind;
    [mix(light.x, r), mix(light.y, g), mix(light.z, b), (alpha * 255.0 + 0.5) as u8]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_share_and_the_seed_select_the_views() {
        for (share, expected) in [(0.0, 0), (0.3, 6), (1.0, 20)] {
            let selected = select_views(1, 20, share);
            assert_eq!(selected.iter().filter(|&&chosen| chosen).count(), expected, "{share}");
        }
        assert_ne!(select_views(1, 20, 0.3), select_views(2, 20, 0.3));
    }

    #[test]
    fn partial_coverage_blends_with_the_pixel_behind() {
        assert_eq!(over(Vec3::ZERO, 1.0, [200, 10, 20, 255]), [0, 0, 0, 255]);
        assert_eq!(over(Vec3::ZERO, 0.5, [200, 100, 0, 255]), [100, 50, 0, 255]);
        assert_eq!(over(Vec3::ONE, 0.5, [200, 100, 0, 0]), [255, 255, 255, 128]);
    }
}
