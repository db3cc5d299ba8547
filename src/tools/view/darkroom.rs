//! From a rendering to a JPEG: compares with the photograph, colours, and encodes. None of this is done by the thread
//! that renders, which may be training; and all of it by one other thread, as of each that ever had a large picture
//! the allocator may keep its buffers.

use std::io;
use std::ops::Range;
use std::thread::{Builder, Scope, ScopedJoinHandle};
use std::time::Instant;

use image::codecs::jpeg::JpegEncoder;
use image::{ExtendedColorType, Rgb, RgbImage, imageops};

use super::asked::{Viewpoint, Wanted};
use super::desk::{Closing, Desk, Unmade};
use super::kinds::Kind;
use super::negative::Negative;
use super::paint::ends;
use super::ramp;
use super::stage::Stage;
use densify_core::camera::Camera;
use densify_core::image::Image8;
use densify_data::views::ViewSource;
use densify_render::Rendering;
use densify_train::evaluate::Split;
use densify_train::metrics::flip_map;
use densify_train::pictures::{photograph, picture, to_u8};

/// Bytes of the stack of the thread that makes pictures. Decoders of photographs need the most of it, less than a
/// quarter.
pub(super) const STACK: usize = 512 << 10;
/// Quality of a picture that stays: at least 38 dB from what was rendered, and 45 dB mostly.
const STILL: u8 = 95;
/// Quality of one that the next will replace at once.
const MOVING: u8 = 80;
/// What the light end of the scale of differences stands for. The whole range reaches to 1, where hardly
/// anything ever is.
const MOST_FLIP: f64 = 0.5;
/// Where the model hides less than this, it has no depth to show.
const LEAST_ALPHA: f32 = 0.02;

/// A picture as it is sent.
#[derive(Debug, Clone)]
pub(super) struct Frame {
    pub(super) jpeg: Vec<u8>,
    pub(super) size: (u32, u32),
    /// What the ends of its scale of colours stand for, if it has one.
    pub(super) range: Option<Range<f64>>,
    /// The mean of what is shown, where that says something.
    pub(super) mean: Option<f64>,
    /// How far away the model is in the middle, in the dataset's own units, if there is any there.
    pub(super) distance: Option<f64>,
    /// Of how many training views its colours are known, and how many there are, where they are measured there.
    pub(super) measured: Option<[usize; 2]>,
    /// What it took to make `[ms]`.
    pub(super) milliseconds: f64,
}

/// A picture before it is encoded.
struct Drawn {
    image: RgbImage,
    range: Option<Range<f64>>,
    mean: Option<f64>,
    distance: Option<f64>,
}

/// Makes pictures of what is rendered until the desk closes; and closes it, should that fail.
pub fn open<'scope>(
    scope: &'scope Scope<'scope, '_>,
    desk: &'scope Desk,
    stage: &'scope Stage,
) -> io::Result<ScopedJoinHandle<'scope, ()>> {
    Builder::new().stack_size(STACK).spawn_scoped(scope, move || {
        let _closing = Closing(desk);
        while let Some((ticket, negative)) = desk.next_exposed() {
            let made = develop(stage, &ticket.wanted, negative).map_err(Unmade::Failed);
            desk.answer(ticket, made);
        }
    })
}

/// Makes the picture of a rendering.
fn develop(stage: &Stage, wanted: &Wanted, negative: Negative) -> Result<Frame, String> {
    let begun = Instant::now();
    let measured = negative.measured;
    let rendered = negative.milliseconds;
    let Drawn { image, range, mean, distance } = draw(stage, wanted, negative)?;
    let quality = if wanted.is_moving { MOVING } else { STILL };
    let mut jpeg = Vec::new();
    let (size, colours) = (image.dimensions(), ExtendedColorType::Rgb8);
    JpegEncoder::new_with_quality(&mut jpeg, quality)
        .encode(image.as_raw(), size.0, size.1, colours)
        .map_err(|error| error.to_string())?;
    let milliseconds = rendered + 1e3 * begun.elapsed().as_secs_f64();
    Ok(Frame { jpeg, size, range, mean, distance, measured, milliseconds })
}

fn draw(stage: &Stage, wanted: &Wanted, negative: Negative) -> Result<Drawn, String> {
    let Negative { rendering, range, .. } = negative;
    let distance = distance(stage, &rendering);
    let plain = |image| Drawn { image, range: None, mean: None, distance };
    Ok(match (wanted.kind, wanted.from) {
        (Kind::Photograph, Viewpoint::View(split, number)) => {
            let image = shot(stage, (split, number), &camera(stage, wanted))?;
            plain(photograph(&image, stage.background))
        }
        (Kind::Difference, Viewpoint::View(split, number)) => {
            let image = shot(stage, (split, number), &camera(stage, wanted))?;
            let map = flip_map(&rendering.rgb, &image, stage.background)
                .map_err(|error| error.to_string())?;
            let mean = map.iter().sum::<f64>() / map.len().max(1) as f64;
            let value = |at: usize| (map[at] / MOST_FLIP) as f32;
            let image = coloured(&rendering, value, |_| true);
            Drawn { image, range: Some(0.0..MOST_FLIP), mean: Some(mean), distance }
        }
        (Kind::Count, _) => {
            let counts = &rendering.depth;
            let most = ends(counts).end.max(1.0);
            let mean =
                counts.iter().copied().map(f64::from).sum::<f64>() / counts.len().max(1) as f64;
            let image = coloured(&rendering, |at| counts[at] / most, |_| true);
            Drawn { image, range: Some(0.0..most.into()), mean: Some(mean), distance: None }
        }
        (Kind::Depth, _) => depth(stage, &rendering),
        (Kind::Opacity, _) => {
            let Rendering { width, height, alpha, .. } = &rendering;
            let grey =
                |x: u32, y: u32| Rgb([to_u8(alpha[y as usize * *width as usize + x as usize]); 3]);
            plain(RgbImage::from_fn(*width, *height, grey))
        }
        _ => Drawn { range, ..plain(picture(&rendering)) },
    })
}

/// The camera to render with. That of a view keeps its shape; at its own size the picture is the one that is
/// measured.
pub(super) fn camera(stage: &Stage, wanted: &Wanted) -> Camera {
    let wanted = &Wanted { size: within(wanted.size, stage.largest), ..wanted.clone() };
    match wanted.from {
        Viewpoint::Free(key) => {
            stage.normalisation.scene_from_world_camera(&key.camera(wanted.size))
        }
        Viewpoint::View(split, number) => {
            let camera = stage.view(split, number).camera;
            let (width, height) = fitted((camera.width, camera.height), wanted);
            match (width, height) == (camera.width, camera.height) {
                true => camera,
                false => camera.resized(width, height),
            }
        }
    }
}

/// A size of the same shape that is no larger than the largest, where there is one.
fn within((width, height): (u32, u32), largest: Option<(u32, u32)>) -> (u32, u32) {
    let Some(most) = largest.filter(|most| width > most.0 || height > most.1) else {
        return (width, height);
    };
    let scale = [(most.0, width), (most.1, height)];
    let [x, y] = scale.map(|(most, wanted)| f64::from(most) / f64::from(wanted));
    let side = |side: u32, most: u32| ((f64::from(side) * x.min(y)) as u32).clamp(1, most);
    (side(width, most.0), side(height, most.1))
}

/// A size of the same shape that fits what is wanted; of photographs not larger than it was.
fn fitted(own: (u32, u32), Wanted { size, kind, .. }: &Wanted) -> (u32, u32) {
    let [width, height] = [own.0, own.1].map(f64::from);
    let scale = (f64::from(size.0) / width).min(f64::from(size.1) / height);
    let side = |side: f64, most: u32| ((side * scale).round() as u32).clamp(1, most);
    match scale >= 1.0 && kind.needs_photograph() {
        true => own,
        false => (side(width, size.0), side(height, size.1)),
    }
}

/// What the camera saw, at the size of the picture.
fn shot(stage: &Stage, (split, number): (Split, usize), camera: &Camera) -> Result<Image8, String> {
    let image = stage.photographs(split).image(number).map_err(|error| error.to_string())?;
    if (image.width, image.height) == (camera.width, camera.height) {
        return Ok((*image).clone());
    }
    // Flattened first, so that what is transparent is blended as it is at full size.
    let flat = photograph(&image, stage.background);
    let filter = imageops::FilterType::Triangle;
    let small = imageops::resize(&flat, camera.width, camera.height, filter);
    let (width, height) = small.dimensions();
    Ok(Image8 { width, height, rgb: small.into_raw(), alpha: None, mask: None })
}

/// A picture of numbers; those that are not there are dark.
fn coloured(
    Rendering { width, height, .. }: &Rendering,
    value: impl Fn(usize) -> f32,
    is_there: impl Fn(usize) -> bool,
) -> RgbImage {
    RgbImage::from_fn(*width, *height, |x, y| {
        let at = y as usize * *width as usize + x as usize;
        Rgb(if is_there(at) { ramp::colour(value(at)).map(to_u8) } else { [0; 3] })
    })
}

/// Depth over opacity: the mean distance of what is seen. What is near is light.
fn depth(stage: &Stage, rendering: &Rendering) -> Drawn {
    let Rendering { alpha, depth, .. } = rendering;
    let is_there = |at: usize| alpha[at] >= LEAST_ALPHA;
    let mean = |at: usize| depth[at] / alpha[at];
    let seen: Vec<f32> = (0..alpha.len()).filter(|&at| is_there(at)).map(mean).collect();
    let range = ends(&seen);
    let width = (range.end - range.start).max(f32::MIN_POSITIVE);
    let image = coloured(rendering, |at| (range.end - mean(at)) / width, is_there);
    let units = 1.0 / stage.normalisation.scale;
    // From dark to light, as the scale is.
    let range = Some(f64::from(range.end) * units..f64::from(range.start) * units);
    Drawn { image, range, mean: None, distance: distance(stage, rendering) }
}

/// The distance in the middle, in the dataset's own units.
fn distance(
    stage: &Stage,
    Rendering { width, height, alpha, depth, .. }: &Rendering,
) -> Option<f64> {
    let at = (*height / 2) as usize * *width as usize + (*width / 2) as usize;
    // Of a photograph nothing is rendered.
    if alpha.is_empty() {
        return None;
    }
    let mean = f64::from(depth[at] / alpha[at]) / stage.normalisation.scale;
    (alpha[at] > 0.5 && mean.is_finite()).then_some(mean)
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use image::DynamicImage;
    use serde_json::json;

    use super::*;
    use crate::open::{stage_of, stage_of_one_view};

    /// A photograph in each format, through a lens that bends.
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
        let scene = json!({
            "w": width, "h": height, "fl_x": width, "fl_y": width, "k1": -0.05,
            "cx": f64::from(width) / 2.0, "cy": f64::from(height) / 2.0,
            "frames": [frame("a.jpg", 0.0), frame("b.png", 1.0), frame("c.webp", -1.0)],
        });
        std::fs::write(folder.join("transforms.json"), scene.to_string()).expect("a file");
    }

    #[test]
    fn large_photographs_need_less_than_a_quarter_of_the_stack() {
        // Of cameras as there are today; differences, which take a minute of those, of smaller ones: what they need
        // besides reading the photograph does not depend on its size.
        let staged = [(4096, 3072), (512, 384)].map(|size| {
            let folder = tempfile::tempdir().expect("a folder");
            photographs(folder.path(), size);
            (stage_of(folder.path()), folder)
        });
        std::thread::scope(|scope| {
            let made = Builder::new().stack_size(STACK / 4).spawn_scoped(scope, || {
                let kinds = [(Kind::Photograph, (2364, 1773)), (Kind::Difference, (320, 240))];
                for ((stage, _folder), (kind, size)) in staged.iter().zip(kinds) {
                    for number in 0..3 {
                        let wanted = Wanted {
                            owner: ("a".to_owned(), 0),
                            kind,
                            model: 0,
                            size,
                            is_moving: false,
                            from: Viewpoint::View(Split::Train, number),
                        };
                        let Camera { width, height, .. } = camera(stage, &wanted);
                        let pixels = width as usize * height as usize;
                        let rendering = Rendering {
                            width,
                            height,
                            rgb: vec![0.5; 3 * pixels],
                            alpha: vec![1.0; pixels],
                            depth: vec![1.0; pixels],
                        };
                        let negative = Negative { rendering, ..Negative::default() };
                        let frame = develop(stage, &wanted, negative).expect("a picture");
                        assert_eq!(frame.size, (width, height));
                    }
                }
            });
            made.expect("a thread").join().expect("pictures");
        });
    }

    #[test]
    fn numbers_are_drawn_from_dark_to_light() {
        let (_folder, stage) = stage_of_one_view();
        let units = 1.0 / stage.normalisation.scale;
        // Near; three times as far, and translucent; nothing.
        let rendering = Rendering {
            width: 3,
            height: 1,
            rgb: vec![0.5; 9],
            alpha: vec![1.0, 0.75, 0.0],
            depth: vec![2.0, 4.5, 0.0],
        };
        let of = |kind| {
            let wanted = Wanted {
                owner: ("a".to_owned(), 0),
                kind,
                model: 0,
                size: (3, 1),
                is_moving: false,
                from: Viewpoint::View(Split::Train, 0),
            };
            let negative = Negative { rendering: rendering.clone(), ..Negative::default() };
            let drawn = draw(&stage, &wanted, negative).expect("a picture");
            let light = |x: u32| drawn.image.get_pixel(x, 0).0.into_iter().map(u32::from).sum();
            let lights: [u32; 3] = [0, 1, 2].map(light);
            (drawn, lights)
        };
        let is_near = |a: f64, b: f64| (a - b).abs() < 1e-5 * units;
        let (depth, [near, far, nothing]) = of(Kind::Depth);
        assert!(near > far && far > nothing && nothing == 0, "{near} {far} {nothing}");
        let range = depth.range.expect("a scale");
        assert!(is_near(range.start, 6.0 * units) && is_near(range.end, 2.0 * units), "{range:?}");
        assert!(depth.distance.is_some_and(|it| is_near(it, 6.0 * units)), "{:?}", depth.distance);
        let (opacity, lights) = of(Kind::Opacity);
        assert_eq!((lights, opacity.range), ([3 * 255, 3 * 191, 0], None));
        let (count, [some, more, none]) = of(Kind::Count);
        assert!(more > some && some > none, "{some} {more} {none}");
        assert_eq!((count.range, count.distance), (Some(0.0..4.5), None));
        assert!(count.mean.is_some_and(|mean| (mean - 6.5 / 3.0).abs() < 1e-6));
    }

    #[test]
    fn pictures_of_a_run_in_training_are_no_larger_than_its_photographs() {
        for (wanted, fitted) in [
            ((64, 48), (64, 48)),
            ((1280, 800), (640, 400)),
            ((800, 1280), (300, 480)),
            ((4096, 1), (640, 1)),
            ((641, 480), (640, 479)),
        ] {
            assert_eq!(within(wanted, Some((640, 480))), fitted);
            assert_eq!(within(wanted, None), wanted);
        }
    }

    #[test]
    fn a_view_keeps_its_shape_and_a_photograph_is_never_enlarged() {
        let wanted = |size: (u32, u32), kind: Kind| Wanted {
            owner: ("a".to_owned(), 0),
            kind,
            model: 0,
            size,
            is_moving: false,
            from: Viewpoint::View(Split::Test, 0),
        };
        for kind in [Kind::Render, Kind::Photograph] {
            let fitted = |own, size| fitted(own, &wanted(size, kind));
            assert_eq!(fitted((640, 480), (640, 480)), (640, 480));
            assert_eq!(fitted((640, 480), (320, 4000)), (320, 240));
            assert_eq!(fitted((5187, 3361), (1000, 100)), (154, 100));
            assert_eq!(fitted((5000, 2), (10, 10)), (10, 1));
            let enlarged = if kind == Kind::Render { (4000, 3000) } else { (640, 480) };
            assert_eq!(fitted((640, 480), (4000, 4000)), enlarged);
        }
    }
}
