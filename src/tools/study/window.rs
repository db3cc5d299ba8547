//! A window of a picture, to look at closely: chosen by a rule and not by hand. Of all windows of a quarter of
//! the picture's sides, and at most 160 px, it is the one with the most edges.

use image::{RgbImage, imageops};

/// Longest side of a window `[px]`: more would be too small to be told apart.
const LONGEST: u32 = 160;

/// A window of a picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Window {
    x: u32,
    y: u32,
    width: u32,
    height: u32,
}

impl Window {
    /// The window with the largest sum of |∂G/∂x| + |∂G/∂y| of the green channel, and that sum; of equal
    /// ones the first, row by row.
    pub fn with_most_edges(picture: &RgbImage) -> (u64, Self) {
        let (width, height) = picture.dimensions();
        let side = |of: u32| (of / 4).clamp(1, LONGEST);
        let window = |x, y| Self { x, y, width: side(width), height: side(height) };
        let Self { width: w, height: h, .. } = window(0, 0);
        // Sums over the rectangle from the corner, so that a window's sum takes four of them.
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

    /// What it shows of a picture.
    pub fn of(self, picture: &RgbImage) -> RgbImage {
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
            let is_on_it = (23..33).contains(&x) && (11..17).contains(&y);
            Rgb([
                100,
                if !is_on_it {
                    100
                } else if (x + y) % 2 == 0 {
                    0
                } else {
                    255
                },
                100,
            ])
        });
        let (edges, window) = Window::with_most_edges(&picture);
        assert!(edges > 0);
        assert!((22..=23).contains(&window.x) && (10..=11).contains(&window.y), "{window:?}");
        assert_eq!(window.of(&picture).dimensions(), (10, 6));
        // Of large photographs too.
        let (_, window) = Window::with_most_edges(&RgbImage::new(2000, 700));
        assert_eq!((window.width, window.height), (160, 160));
    }
}
