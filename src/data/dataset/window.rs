//! Crops views to a part of their image, such as the part that shows a block of a large scene.

use std::fmt;
use std::str::FromStr;

use super::View;
use densify_core::camera::Camera;
use densify_core::image::Window;

/// Smallest side of a window `[px]`: around a smaller window, most pixels of the rendered tiles would lie outside.
const MIN_SIDE: u32 = 32;

/// A rectangular part of an image. Coordinates are fractions of its width and height, in `[0, 1]`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Part {
    /// Left side.
    pub left: f64,
    /// Upper side.
    pub top: f64,
    /// Right side.
    pub right: f64,
    /// Lower side.
    pub bottom: f64,
}

/// The text form of a part: left, top, right and bottom.
impl fmt::Display for Part {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { left, top, right, bottom } = self;
        write!(out, "{left:.4} {top:.4} {right:.4} {bottom:.4}")
    }
}

impl FromStr for Part {
    type Err = ();

    fn from_str(text: &str) -> Result<Self, ()> {
        let numbers: Result<Vec<f64>, _> = text.split_whitespace().map(str::parse).collect();
        let [left, top, right, bottom] = numbers.map_err(|_| ())?[..] else { return Err(()) };
        let part = Self { left, top, right, bottom };
        if part.is_valid() { Ok(part) } else { Err(()) }
    }
}

impl Part {
    /// Returns true if the sides are in order and inside the image.
    fn is_valid(&self) -> bool {
        let is_span = |from: f64, to: f64| 0.0 <= from && from < to && to <= 1.0;
        is_span(self.left, self.right) && is_span(self.top, self.bottom)
    }

    /// The pixels of the part in an image of this size; `None` if it covers the whole image.
    fn window(&self, width: u32, height: u32) -> Option<Window> {
        let [x, across] = span(self.left, self.right, width);
        let [y, down] = span(self.top, self.bottom, height);
        let window = Window { x, y, width: across, height: down };
        (window != Window { x: 0, y: 0, width, height }).then_some(window)
    }
}

/// First pixel and number of pixels of a span, widened to [`MIN_SIDE`] pixels or, in a smaller image, to the whole
/// side.
fn span(from: f64, to: f64, size: u32) -> [u32; 2] {
    let (from, to) = (from * f64::from(size), to * f64::from(size));
    let min_side = f64::from(MIN_SIDE.min(size));
    let middle = 0.5 * (from + to);
    let (from, to) = (from.min(middle - 0.5 * min_side), to.max(middle + 0.5 * min_side));
    // Shift the span back into the image.
    let shift = (-from).max(0.0) - (to - f64::from(size)).max(0.0);
    let first = (from + shift).max(0.0).floor() as u32;
    let last = ((to + shift).ceil() as u32).min(size);
    [first, last - first]
}

impl View {
    /// Crops the view to a part of its image.
    pub(crate) fn windowed(mut self, part: &Part) -> Self {
        if let Some(window) = part.window(self.camera.width, self.camera.height) {
            self.camera = Camera {
                width: window.width,
                height: window.height,
                cx: self.camera.cx - f64::from(window.x),
                cy: self.camera.cy - f64::from(window.y),
                ..self.camera
            };
            self.source.window = Some(window);
        }
        self
    }
}

#[cfg(test)]
#[allow(clippy::float_cmp, reason = "exact values")]
mod tests {
    use super::*;
    use crate::dataset::images::ImageSource;
    use crate::dataset::{Dataset, LoadOptions};
    use densify_core::image::Image8;
    use densify_fixtures::Made;

    #[test]
    fn windows_contain_their_part_and_stay_in_the_image() {
        let part = |left, right| Part { left, right, top: 0.25, bottom: 0.75 };
        let window = |left, right| part(left, right).window(200, 100);
        assert_eq!(window(0.5, 0.9), Some(Window { x: 100, y: 25, width: 80, height: 50 }));
        // Parts that are too narrow are widened evenly, or inwards at a border.
        assert_eq!(window(0.5, 0.52), Some(Window { x: 86, y: 25, width: 32, height: 50 }));
        assert_eq!(window(0.0, 0.01).map(|window| (window.x, window.width)), Some((0, 32)));
        assert_eq!(window(0.99, 1.0).map(|window| (window.x, window.width)), Some((168, 32)));
        let whole = Part { left: 0.0, top: 0.0, right: 1.0, bottom: 1.0 };
        assert_eq!(whole.window(200, 100), None);
        // A smaller image is used as a whole.
        assert_eq!(part(0.4, 0.6).window(30, 30), None);
        let is_valid = |left, right| part(left, right).is_valid();
        assert!(is_valid(0.1, 0.2) && !is_valid(0.2, 0.1) && !is_valid(0.5, 1.1));
        assert!(!part(f64::NAN, 1.0).is_valid());
    }

    #[test]
    fn a_windowed_view_shows_the_same_as_its_part_of_the_whole_view() {
        let made = Made::colmap_txt();
        let dataset = Dataset::load(made.path(), &LoadOptions::default()).expect("a dataset");
        let (width, height) = (60, 40);
        let rgb = (0..3 * width * height).map(|i| (i * 7 % 251) as u8).collect();
        let pixels = Image8 { width, height, rgb, alpha: None, mask: None };
        let mut view = dataset.train[0].clone();
        view.camera = view.camera.resized(width, height);
        view.source = ImageSource::rendered("made".into(), pixels, (width, height));
        let view = &view;
        let part = Part { left: 0.3, top: 0.0, right: 0.9, bottom: 1.0 };
        let cut = view.clone().windowed(&part);
        let window = cut.source.window.expect("a part");
        assert!(window.x > 0 && window.width < width && cut.camera.height == height, "{window:?}");
        let [whole, image] = [view, &cut].map(|view| view.source.load().expect("an image"));
        assert_eq!((image.width, image.height), (cut.camera.width, cut.camera.height));
        assert!(image.bytes() <= cut.source.loaded_bytes());
        let point = view.camera.centre() + view.camera.forward();
        let [before, after] = [view, &cut].map(|view| view.camera.project(point).0);
        assert_eq!(before.x - after.x, f64::from(window.x));
        for y in 0..height as usize {
            let black = [0.0; 3];
            let x = image.width as usize - 1;
            let expected = whole.composited(x + window.x as usize, y, black);
            assert_eq!(image.composited(x, y, black), expected);
        }
    }

    #[test]
    fn a_windowed_image_has_the_pixels_of_its_window() {
        let image = Image8 {
            width: 5,
            height: 4,
            rgb: (0..60).collect(),
            alpha: None,
            mask: Some((0..20).collect()),
        };
        let cut = image.windowed(Window { x: 1, y: 2, width: 2, height: 2 });
        assert_eq!((cut.width, cut.height), (2, 2));
        assert_eq!(cut.rgb, [33, 34, 35, 36, 37, 38, 48, 49, 50, 51, 52, 53]);
        assert_eq!(cut.mask, Some(vec![11, 12, 16, 17]));
    }
}
