//! Chooses a crop of a picture for comparison by a fixed rule: the window with the most edges. Its sides are a quarter
//! of the picture's, at most 160 px.

use image::{RgbImage, imageops};

/// Longest side of a window `[px]`. Larger windows could not be shown enlarged.
const MAX_SIDE: u32 = 160;

/// A window of a picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Window {
    x: u32,
    y: u32,
    width: u32,
    height: u32,
}

impl Window {
    /// The window with the largest sum of |∂G/∂x| + |∂G/∂y| of the green channel, and that sum. Of windows with equal
    /// sums, the first in row-major order.
    pub fn with_most_edges(picture: &RgbImage) -> (u64, Self) {
        let (width, height) = picture.dimensions();
        let side = |length: u32| (length / 4).clamp(1, MAX_SIDE);
        let window = |x, y| Self { x, y, width: side(width), height: side(height) };
        let Self { width: w, height: h, .. } = window(0, 0);
        // A summed-area table: the sum over a window takes four entries.
        let columns = width as usize + 1;
        let mut sums = vec![0_u64; columns * (height as usize + 1)];
        let green =
            |x: u32, y: u32| i32::from(picture.get_pixel(x.min(width - 1), y.min(height - 1))[1]);
        for y in 0..height {
            let mut row = 0;
            for x in 0..width {
                let edge =
                    (green(x + 1, y) - green(x, y)).abs() + (green(x, y + 1) - green(x, y)).abs();
                row += u64::from(edge.unsigned_abs());
                let at = (y as usize + 1) * columns + x as usize + 1;
                sums[at] = sums[at - columns] + row;
            }
        }
        let sum = |x: u32, y: u32| sums[y as usize * columns + x as usize];
        let mut best = (0, window(0, 0));
        for y in 0..=height - h {
            for x in 0..=width - w {
                let edges = sum(x + w, y + h) + sum(x, y) - sum(x + w, y) - sum(x, y + h);
                if edges > best.0 {
                    best = (edges, window(x, y));
                }
            }
        }
        best
    }

    /// Crops a picture to the window.
    pub fn crop(self, picture: &RgbImage) -> RgbImage {
        imageops::crop_imm(picture, self.x, self.y, self.width, self.height).to_image()
    }
}

#[cfg(test)]
mod tests {
    use image::Rgb;

    use super::*;

    #[test]
    fn the_window_with_the_most_edges_is_found() {
        // A checkerboard of 10 × 6 pixels, as large as a window.
        let picture = RgbImage::from_fn(40, 24, |x, y| {
            let is_inside = (23..33).contains(&x) && (11..17).contains(&y);
            let green = if is_inside { 255 * ((x + y) % 2) as u8 } else { 100 };
            Rgb([100, green, 100])
        });
        let (edges, window) = Window::with_most_edges(&picture);
        assert!(edges > 0);
        assert!((22..=23).contains(&window.x) && (10..=11).contains(&window.y), "{window:?}");
        assert_eq!(window.crop(&picture).dimensions(), (10, 6));
        // Windows of large photographs are limited in size.
        let (_, window) = Window::with_most_edges(&RgbImage::new(2000, 700));
        assert_eq!((window.width, window.height), (160, 160));
    }
}
