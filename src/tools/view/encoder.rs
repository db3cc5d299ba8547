//! Turns renderings into JPEGs: compares with photographs, applies colour maps, and encodes. One separate thread does
//! all of it: the rendering thread may be training, and an allocator may keep the buffers of large pictures for every
//! thread that ever used them.

use std::io;
use std::ops::Range;
use std::thread::{Builder, Scope, ScopedJoinHandle};
use std::time::Instant;

use image::codecs::jpeg::JpegEncoder;
use image::{ExtendedColorType, Rgb, RgbImage, imageops};

use super::colour_map;
use super::picture_kind::PictureKind;
use super::picture_request::{PictureRequest, Viewpoint};
use super::render::RenderedPicture;
use super::render_queue::{CloseOnDrop, RenderError, RenderQueue};
use super::row_colours::ends;
use super::scene::Scene;
use densify_core::camera::Camera;
use densify_core::image::Image8;
use densify_data::views::ViewSource;
use densify_render::Rendering;
use densify_train::evaluate::Split;
use densify_train::metrics::flip_map;
use densify_train::pictures::{photograph, picture, to_u8};

/// Stack of the encoder thread `[bytes]`. Image decoders use more of it than anything else, but less than a quarter.
pub(super) const STACK: usize = 512 << 10;
/// JPEG quality at rest: its PSNR against the rendering is at least 38 dB, usually 45 dB.
const STILL_QUALITY: u8 = 95;
/// JPEG quality while the camera moves.
const MOVING_QUALITY: u8 = 80;
/// The difference at the light end of the colour map. FLIP reaches 1, but values above this are rare.
const MAX_FLIP: f64 = 0.5;
/// Minimum opacity of a pixel for its depth to be shown.
const MIN_ALPHA: f32 = 0.02;

/// A picture ready to be sent.
#[derive(Debug, Clone, Default)]
pub(super) struct EncodedPicture {
    pub(super) jpeg: Vec<u8>,
    pub(super) size: (u32, u32),
    /// The values at both ends of the colour map, if the colours represent numbers.
    pub(super) range: Option<Range<f64>>,
    /// The mean of the shown numbers, where it is meaningful.
    pub(super) mean: Option<f64>,
    /// Distance to the model at the centre of the picture, in the dataset's own units.
    pub(super) distance: Option<f64>,
    /// Number of training views in which the Gaussians were measured, and number of all training views.
    pub(super) measured_views: Option<[usize; 2]>,
    /// Time for rendering and encoding `[ms]`.
    pub(super) milliseconds: f64,
}

/// A picture before it is encoded.
struct Drawn {
    image: RgbImage,
    range: Option<Range<f64>>,
    mean: Option<f64>,
    distance: Option<f64>,
}

/// Starts the encoder thread. It runs until the queue is closed, and closes the queue if it panics.
pub(super) fn start<'scope>(
    scope: &'scope Scope<'scope, '_>,
    queue: &'scope RenderQueue,
    scene: &'scope Scene,
) -> io::Result<ScopedJoinHandle<'scope, ()>> {
    Builder::new().stack_size(STACK).spawn_scoped(scope, move || {
        let _close = CloseOnDrop(queue);
        while let Some((job, rendered)) = queue.next_rendered() {
            let encoded = encode(scene, &job.request, rendered).map_err(RenderError::Failed);
            queue.finish(job, encoded);
        }
    })
}

/// Draws a rendering and encodes it.
fn encode(
    scene: &Scene,
    request: &PictureRequest,
    rendered: RenderedPicture,
) -> Result<EncodedPicture, String> {
    let begun = Instant::now();
    let measured_views = rendered.measured_views;
    let rendering_time = rendered.milliseconds;
    let Drawn { image, range, mean, distance } = draw(scene, request, rendered)?;
    let quality = if request.is_moving { MOVING_QUALITY } else { STILL_QUALITY };
    let mut jpeg = Vec::new();
    let (size, colours) = (image.dimensions(), ExtendedColorType::Rgb8);
    JpegEncoder::new_with_quality(&mut jpeg, quality)
        .encode(image.as_raw(), size.0, size.1, colours)
        .map_err(|error| error.to_string())?;
    let milliseconds = rendering_time + 1e3 * begun.elapsed().as_secs_f64();
    Ok(EncodedPicture { jpeg, size, range, mean, distance, measured_views, milliseconds })
}

fn draw(
    scene: &Scene,
    request: &PictureRequest,
    rendered: RenderedPicture,
) -> Result<Drawn, String> {
    let RenderedPicture { rendering, range, .. } = rendered;
    let distance = distance(scene, &rendering);
    let plain = |image| Drawn { image, range: None, mean: None, distance };
    Ok(match (request.kind, request.camera) {
        (PictureKind::Photograph, Viewpoint::View(split, number)) => {
            let image = resized_photograph(scene, (split, number), &camera(scene, request))?;
            plain(photograph(&image, scene.background))
        }
        (PictureKind::Difference, Viewpoint::View(split, number)) => {
            let image = resized_photograph(scene, (split, number), &camera(scene, request))?;
            let map = flip_map(&rendering.rgb, &image, scene.background)
                .map_err(|error| error.to_string())?;
            let mean = map.iter().sum::<f64>() / map.len().max(1) as f64;
            let value = |at: usize| (map[at] / MAX_FLIP) as f32;
            let image = draw_numbers(&rendering, value, |_| true);
            Drawn { image, range: Some(0.0..MAX_FLIP), mean: Some(mean), distance }
        }
        (PictureKind::Count, _) => {
            // Counts are rendered as depth.
            let counts = &rendering.depth;
            let most = ends(counts).end.max(1.0);
            let mean =
                counts.iter().copied().map(f64::from).sum::<f64>() / counts.len().max(1) as f64;
            let image = draw_numbers(&rendering, |at| counts[at] / most, |_| true);
            Drawn { image, range: Some(0.0..most.into()), mean: Some(mean), distance: None }
        }
        (PictureKind::Depth, _) => draw_depth(scene, &rendering),
        (PictureKind::Opacity, _) => {
            let Rendering { width, height, alpha, .. } = &rendering;
            let grey =
                |x: u32, y: u32| Rgb([to_u8(alpha[y as usize * *width as usize + x as usize]); 3]);
            plain(RgbImage::from_fn(*width, *height, grey))
        }
        _ => Drawn { range, ..plain(picture(&rendering)) },
    })
}

/// The camera to render with. The camera of a view keeps its aspect ratio; at full size it is unchanged, so that the
/// picture is the one that is evaluated.
pub(super) fn camera(scene: &Scene, request: &PictureRequest) -> Camera {
    let size = limit_size(request.size, scene.largest);
    match request.camera {
        Viewpoint::Free(key) => scene.normalisation.scene_from_world_camera(&key.camera(size)),
        Viewpoint::View(split, number) => {
            let camera = scene.view(split, number).camera;
            let own = (camera.width, camera.height);
            let (width, height) = fit_size(own, size, request.kind);
            if (width, height) == own { camera } else { camera.resized(width, height) }
        }
    }
}

/// Shrinks a size to the largest allowed one, keeping the aspect ratio.
fn limit_size((width, height): (u32, u32), largest: Option<(u32, u32)>) -> (u32, u32) {
    let Some(largest) = largest.filter(|most| width > most.0 || height > most.1) else {
        return (width, height);
    };
    let [x, y] =
        [(largest.0, width), (largest.1, height)].map(|(a, b)| f64::from(a) / f64::from(b));
    let side = |side: u32, largest: u32| ((f64::from(side) * x.min(y)) as u32).clamp(1, largest);
    (side(width, largest.0), side(height, largest.1))
}

/// Scales a view's own size to fit the requested one; photographs are never enlarged.
fn fit_size(own: (u32, u32), size: (u32, u32), kind: PictureKind) -> (u32, u32) {
    let [width, height] = [own.0, own.1].map(f64::from);
    let scale = (f64::from(size.0) / width).min(f64::from(size.1) / height);
    let side = |side: f64, most: u32| ((side * scale).round() as u32).clamp(1, most);
    if scale >= 1.0 && kind.needs_photograph() {
        return own;
    }
    (side(width, size.0), side(height, size.1))
}

/// The photograph of a view, at the size of the picture.
fn resized_photograph(
    scene: &Scene,
    (split, number): (Split, usize),
    camera: &Camera,
) -> Result<Image8, String> {
    let image = scene.photographs(split).image(number).map_err(|error| error.to_string())?;
    if (image.width, image.height) == (camera.width, camera.height) {
        return Ok((*image).clone());
    }
    // The photograph is flattened first, so that transparent parts are blended as at full size.
    let flat = photograph(&image, scene.background);
    let filter = imageops::FilterType::Triangle;
    let small = imageops::resize(&flat, camera.width, camera.height, filter);
    let (width, height) = small.dimensions();
    Ok(Image8 { width, height, rgb: small.into_raw(), alpha: None, mask: None })
}

/// A picture of numbers; pixels without a number are black.
fn draw_numbers(
    Rendering { width, height, .. }: &Rendering,
    value: impl Fn(usize) -> f32,
    is_valid: impl Fn(usize) -> bool,
) -> RgbImage {
    RgbImage::from_fn(*width, *height, |x, y| {
        let at = y as usize * *width as usize + x as usize;
        Rgb(if is_valid(at) { colour_map::colour(value(at)).map(to_u8) } else { [0; 3] })
    })
}

/// A picture of the mean depth, accumulated depth over opacity. Near is light.
fn draw_depth(scene: &Scene, rendering: &Rendering) -> Drawn {
    let Rendering { alpha, depth, .. } = rendering;
    let is_valid = |at: usize| alpha[at] >= MIN_ALPHA;
    let mean = |at: usize| depth[at] / alpha[at];
    let seen: Vec<f32> = (0..alpha.len()).filter(|&at| is_valid(at)).map(mean).collect();
    let range = ends(&seen);
    let width = (range.end - range.start).max(f32::MIN_POSITIVE);
    let image = draw_numbers(rendering, |at| (range.end - mean(at)) / width, is_valid);
    let units = 1.0 / scene.normalisation.scale;
    // In the order of the colour map, from dark to light.
    let range = Some(f64::from(range.end) * units..f64::from(range.start) * units);
    Drawn { image, range, mean: None, distance: distance(scene, rendering) }
}

/// Distance to the model at the centre of the picture, in the dataset's own units.
fn distance(
    scene: &Scene,
    Rendering { width, height, alpha, depth, .. }: &Rendering,
) -> Option<f64> {
    let at = (*height / 2) as usize * *width as usize + (*width / 2) as usize;
    // Nothing is rendered for a request for a photograph.
    if alpha.is_empty() {
        return None;
    }
    let mean = f64::from(depth[at] / alpha[at]) / scene.normalisation.scale;
    (alpha[at] > 0.5 && mean.is_finite()).then_some(mean)
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use image::DynamicImage;
    use serde_json::json;

    use super::*;
    use crate::open::{scene_of, scene_of_one_view};

    /// Writes a dataset with a photograph in each format, with lens distortion.
    fn photographs(folder: &Path, (width, height): (u32, u32)) {
        let noise = |x: u32, y: u32| (x.wrapping_mul(2_654_435_769) ^ y.wrapping_mul(40_503)) >> 9;
        let image = RgbImage::from_fn(width, height, |x, y| {
            let grain = noise(x, y) as u8 / 4;
            Rgb([(x / 16) as u8 / 2 + grain, (y / 12) as u8 / 2 + grain, grain])
        });
        let image = DynamicImage::from(image);
        image.save(folder.join("a.jpg")).expect("a JPEG");
        DynamicImage::from(image.to_rgb16()).save(folder.join("b.png")).expect("a PNG");
        image.save(folder.join("c.webp")).expect("a WebP");
        let frame = |name: &str, x: f64| {
            let pose = [
                [1.0, 0.0, 0.0, x],
                [0.0, 1.0, 0.0, 0.0],
                [0.0, 0.0, 1.0, 4.0],
                [0.0, 0.0, 0.0, 1.0],
            ];
            json!({ "file_path": name, "transform_matrix": pose })
        };
        let transforms = json!({
            "w": width, "h": height, "fl_x": width, "fl_y": width, "k1": -0.05,
            "cx": f64::from(width) / 2.0, "cy": f64::from(height) / 2.0,
            "frames": [frame("a.jpg", 0.0), frame("b.png", 1.0), frame("c.webp", -1.0)],
        });
        std::fs::write(folder.join("transforms.json"), transforms.to_string()).expect("a file");
    }

    #[test]
    fn large_photographs_need_less_than_a_quarter_of_the_stack() {
        // The first photographs are as large as those of a current camera. Differences are tested on smaller
        // photographs, as large ones would take a minute; except for reading the photograph, the stack needed does not
        // depend on its size.
        let scenes = [(4096, 3072), (512, 384)].map(|size| {
            let folder = tempfile::tempdir().expect("a folder");
            photographs(folder.path(), size);
            (scene_of(folder.path()), folder)
        });
        std::thread::scope(|scope| {
            let made = Builder::new().stack_size(STACK / 4).spawn_scoped(scope, || {
                let kinds = [
                    (PictureKind::Photograph, (2364, 1773)),
                    (PictureKind::Difference, (320, 240)),
                ];
                for ((scene, _folder), (kind, size)) in scenes.iter().zip(kinds) {
                    for number in 0..3 {
                        let request = PictureRequest::of_view("a", kind, size, number);
                        let Camera { width, height, .. } = camera(scene, &request);
                        let pixels = width as usize * height as usize;
                        let rendering = Rendering {
                            width,
                            height,
                            rgb: vec![0.5; 3 * pixels],
                            alpha: vec![1.0; pixels],
                            depth: vec![1.0; pixels],
                        };
                        let rendered = RenderedPicture { rendering, ..RenderedPicture::default() };
                        let picture = encode(scene, &request, rendered).expect("a picture");
                        assert_eq!(picture.size, (width, height));
                    }
                }
            });
            made.expect("a thread").join().expect("pictures");
        });
    }

    #[test]
    fn numbers_are_drawn_from_dark_to_light() {
        let (_folder, scene) = scene_of_one_view();
        let units = 1.0 / scene.normalisation.scale;
        // A near pixel, a translucent one three times as far away, and an empty one.
        let rendering = Rendering {
            width: 3,
            height: 1,
            rgb: vec![0.5; 9],
            alpha: vec![1.0, 0.75, 0.0],
            depth: vec![2.0, 4.5, 0.0],
        };
        let draw_kind = |kind| {
            let request = PictureRequest::of_view("a", kind, (3, 1), 0);
            let rendered =
                RenderedPicture { rendering: rendering.clone(), ..RenderedPicture::default() };
            let drawn = draw(&scene, &request, rendered).expect("a picture");
            let light = |x: u32| drawn.image.get_pixel(x, 0).0.into_iter().map(u32::from).sum();
            let lights: [u32; 3] = [0, 1, 2].map(light);
            (drawn, lights)
        };
        let is_near = |a: f64, b: f64| (a - b).abs() < 1e-5 * units;
        let (depth, [near, far, nothing]) = draw_kind(PictureKind::Depth);
        assert!(near > far && far > nothing && nothing == 0, "{near} {far} {nothing}");
        let range = depth.range.expect("a scale");
        assert!(is_near(range.start, 6.0 * units) && is_near(range.end, 2.0 * units), "{range:?}");
        let distance = depth.distance.expect("a distance");
        assert!(is_near(distance, 6.0 * units), "{distance}");
        let (opacity, lights) = draw_kind(PictureKind::Opacity);
        assert_eq!((lights, opacity.range), ([3 * 255, 3 * 191, 0], None));
        let (count, [some, more, none]) = draw_kind(PictureKind::Count);
        assert!(more > some && some > none, "{some} {more} {none}");
        assert_eq!((count.range, count.distance), (Some(0.0..4.5), None));
        assert!(count.mean.is_some_and(|mean| (mean - 6.5 / 3.0).abs() < 1e-6));
    }

    #[test]
    fn pictures_of_a_run_in_training_are_no_larger_than_its_photographs() {
        for (size, limited) in [
            ((64, 48), (64, 48)),
            ((1280, 800), (640, 400)),
            ((800, 1280), (300, 480)),
            ((4096, 1), (640, 1)),
            ((641, 480), (640, 479)),
        ] {
            assert_eq!(limit_size(size, Some((640, 480))), limited);
            assert_eq!(limit_size(size, None), size);
        }
    }

    #[test]
    fn a_view_keeps_its_aspect_ratio_and_a_photograph_is_never_enlarged() {
        for kind in [PictureKind::Render, PictureKind::Photograph] {
            let fitted = |own, size| fit_size(own, size, kind);
            assert_eq!(fitted((640, 480), (640, 480)), (640, 480));
            assert_eq!(fitted((640, 480), (320, 4000)), (320, 240));
            assert_eq!(fitted((5187, 3361), (1000, 100)), (154, 100));
            assert_eq!(fitted((5000, 2), (10, 10)), (10, 1));
            let enlarged = if kind == PictureKind::Render { (4000, 3000) } else { (640, 480) };
            assert_eq!(fitted((640, 480), (4000, 4000)), enlarged);
        }
    }
}
