//! Undistortion: resampling the image of a lens to that of a pinhole camera.

use glam::{DMat3, DVec2, DVec3};

use super::lens::Lens;
use densify_core::image::Image8;
use densify_core::image::resample::PixelMean;
use densify_core::spline::catmull_rom;

/// The image of a camera without distortion. The upper left corner is (0, 0); pixel centres are at +0.5.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Pinhole {
    /// Image width `[px]`.
    pub(super) width: u32,
    /// Image height `[px]`.
    pub(super) height: u32,
    /// Focal lengths `[px]`.
    pub(super) focal: DVec2,
    /// Principal point `[px]`.
    pub(super) principal: DVec2,
}

/// Resampling of a lens's image to a pinhole's. Its `Debug` text is part of the fingerprint in checkpoints.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Undistortion {
    /// The lens that took the image, at the image's size.
    pub(super) from: Lens,
    /// The pinhole that images are resampled to.
    pub(super) to: Pinhole,
    /// Rotation from the pinhole's axes to the lens's.
    pub(super) lens_from_pinhole: DMat3,
    /// True if the lens saw only a part of the pinhole's image, so that the rest is masked.
    pub(super) masked: bool,
}

impl Undistortion {
    /// Returns true if the pinhole's image contains a ray of the lens.
    pub(super) fn shows(&self, ray: DVec3) -> bool {
        let ray = self.lens_from_pinhole.transpose() * ray;
        let at = ray.truncate() / ray.z * self.to.focal + self.to.principal;
        let size = DVec2::new(f64::from(self.to.width), f64::from(self.to.height));
        // The borders of both images agree up to rounding.
        ray.z > 0.0 && (at.cmpge(DVec2::splat(-1e-6)) & at.cmple(size + 1e-6)).all()
    }

    /// Position in the lens's image of a point in the pinhole's image `[px]`; `None` if the lens did not see the point.
    pub(super) fn source_of(&self, pixel: DVec2) -> Option<DVec2> {
        let p = (pixel - self.to.principal) / self.to.focal;
        let ray = self.lens_from_pinhole * p.extend(1.0);
        if !self.masked {
            // Every point was seen by construction; rounding must not make holes at the border.
            return self.from.extrapolate(ray);
        }
        self.from.project(ray).filter(|at| self.from.images(*at, 0.0))
    }

    /// Resamples an image of the lens in one row-major pass.
    ///
    /// Interpolation is bicubic, because bilinear interpolation blurs and costs half a dB in test views
    /// (docs/studies/disturbances.tsv).
    /// Near masked pixels it is bilinear, so that hidden colours do not reach pixels that count.
    pub(super) fn apply(&self, image: &Image8) -> Image8 {
        let (width, height) = (self.to.width, self.to.height);
        let mut out = Image8::blank(width, height, image);
        if self.masked && out.mask.is_none() {
            out.mask = Some(Vec::with_capacity(width as usize * height as usize));
        }
        let last = DVec2::new(f64::from(image.width - 1), f64::from(image.height - 1));
        for y in 0..height {
            for x in 0..width {
                let source = self.source_of(DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5));
                let mut mean = PixelMean::default();
                // Beyond the centres of the outermost pixels, those pixels are repeated.
                if let Some(at) = source {
                    let at = (at - 0.5).clamp(DVec2::ZERO, last);
                    let [columns, rows] =
                        [Stencil::around(at.x, image.width), Stencil::around(at.y, image.height)];
                    let hides = |mask: &Vec<u8>| {
                        let row = |y: u32| y as usize * image.width as usize;
                        let hidden = |x: u32, y: u32| mask[row(y) + x as usize] < 255;
                        rows.places.iter().any(|&y| columns.places.iter().any(|&x| hidden(x, y)))
                    };
                    let weights = if image.mask.as_ref().is_some_and(hides) {
                        [columns.linear(), rows.linear()]
                    } else {
                        [columns.cubic(), rows.cubic()]
                    };
                    for (&y, wy) in rows.places.iter().zip(weights[1]) {
                        for (&x, wx) in columns.places.iter().zip(weights[0]) {
                            mean.add(image, x, y, wx * wy);
                        }
                    }
                }
                mean.push_to(&mut out);
            }
        }
        out
    }
}

/// The four pixels around a position along one axis.
struct Stencil {
    /// Indices of the pixels; beyond the border, that of the outermost pixel.
    places: [u32; 4],
    /// Position between the second pixel (0) and the third (1).
    t: f32,
}

impl Stencil {
    /// The stencil of a position between the centres of the first and the last pixel.
    fn around(at: f64, side: u32) -> Self {
        let second = at as u32;
        let places = [second.saturating_sub(1), second, second + 1, second + 2];
        let t = (at - f64::from(second)) as f32;
        Self { places: places.map(|place| place.min(side - 1)), t }
    }

    fn linear(&self) -> [f32; 4] {
        [0.0, 1.0 - self.t, self.t, 0.0]
    }

    fn cubic(&self) -> [f32; 4] {
        catmull_rom(f64::from(self.t)).map(|weight| weight as f32)
    }
}

#[cfg(test)]
mod tests {
    use super::super::lens::{Distortion, Pinholes, Projection};
    use super::*;

    const SIZE: (u32, u32) = (90, 60);

    /// Resamples a fisheye's image with these channels (grey, alpha, mask) at each pixel centre.
    fn resampled(image: impl Fn(DVec2) -> [u8; 3]) -> (Image8, Undistortion) {
        let (width, height) = SIZE;
        let place = |i: u32| DVec2::new(f64::from(i % width) + 0.5, f64::from(i / width) + 0.5);
        let channels: Vec<[u8; 3]> = (0..width * height).map(|i| image(place(i))).collect();
        let rgb = channels.iter().flat_map(|[grey, ..]| [*grey; 3]).collect();
        let channel = |c: usize| Some(channels.iter().map(|pixel| pixel[c]).collect());
        let image = Image8 { width, height, rgb, alpha: channel(1), mask: channel(2) };
        let undistortion = undistortion();
        (undistortion.apply(&image), undistortion)
    }

    fn undistortion() -> Undistortion {
        let (focal, middle) = (DVec2::splat(70.0), DVec2::new(45.0, 30.0));
        let lens = Lens::new(SIZE, focal, middle, Distortion::none(Projection::Equidistant));
        Pinholes::covering(&lens, false).unwrap().faces[0].1
    }

    fn centre(out: &Image8, index: usize) -> DVec2 {
        let (x, y) = (index as u32 % out.width, index as u32 / out.width);
        DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5)
    }

    /// A wave of 5 px, which bilinear interpolation flattens by up to a fifth.
    #[test]
    fn sharp_images_stay_sharp() {
        let wave = |at: DVec2| 128.0 + 100.0 * (at.x * 1.1).sin() * (at.y * 0.7).cos();
        let (out, undistortion) = resampled(|at| [wave(at).round() as u8, 255, 255]);
        let (mut squares, mut count) = (0.0, 0);
        for (index, pixel) in out.rgb.chunks_exact(3).enumerate() {
            let at = undistortion.source_of(centre(&out, index)).unwrap();
            if (at - DVec2::new(45.0, 30.0)).abs().cmplt(DVec2::new(42.0, 27.0)).all() {
                squares += (f64::from(pixel[0]) - wave(at)).powi(2);
                count += 1;
            }
        }
        let error = (squares / f64::from(count)).sqrt();
        assert!(count > 4000 && error < 4.0, "{error} of {count}");
    }

    /// Bicubic interpolation overshoots beside an edge, which must not produce other colours, and the outermost pixels
    /// are repeated beyond the border.
    #[test]
    fn edges_and_borders_get_no_other_colours() {
        let (out, undistortion) = resampled(|at| [if at.x < 45.0 { 0 } else { 255 }, 255, 255]);
        for (index, pixel) in out.rgb.chunks_exact(3).enumerate() {
            let at = undistortion.source_of(centre(&out, index)).unwrap().x;
            let is_right = match pixel[0] {
                0 => at < 45.5,
                255 => at > 44.5,
                1..=126 => at > 43.5 && at < 45.0,
                129..=254 => at > 45.0 && at < 46.5,
                _ => (at - 45.0).abs() < 0.01,
            };
            assert!(is_right, "{pixel:?} at {at}");
        }
        assert!(out.alpha.is_some_and(|alpha| alpha.iter().all(|&a| a == 255)));
    }

    #[test]
    fn the_outermost_pixels_are_repeated() {
        for (at, places) in [
            (0.2, [0, 0, 1, 2]),
            (5.5, [4, 5, 6, 7]),
            (88.5, [87, 88, 89, 89]),
            (89.0, [88, 89, 89, 89]),
        ] {
            assert_eq!(Stencil::around(at, 90).places, places, "{at}");
        }
    }

    #[test]
    fn hidden_pixels_do_not_affect_visible_ones() {
        let is_hidden = |at: DVec2| (at - DVec2::new(40.0, 30.0)).length() < 9.0;
        let with = |hidden: u8| {
            let colour = |at: DVec2| if is_hidden(at) { hidden } else { 90 };
            resampled(|at| [colour(at), 255, if is_hidden(at) { 0 } else { 255 }]).0
        };
        let (dark, bright) = (with(0), with(255));
        assert_eq!(dark.mask, bright.mask);
        let mut counted = 0;
        for (index, &weight) in dark.mask.as_ref().unwrap().iter().enumerate() {
            let [a, b] = [&dark, &bright].map(|out| out.rgb[3 * index]);
            // Hidden colours may contribute only as much as the pixel's weight is below 1.
            let most = f64::from(255 - weight) + 1.0;
            assert!(f64::from(a.abs_diff(b)) <= most, "{a} {b} {weight}");
            counted += usize::from(weight == 255);
        }
        assert!(counted > 4000 && dark.mask.unwrap().contains(&0));
    }

    #[test]
    fn transparent_colour_does_not_bleed_and_masks_are_not_sharpened() {
        let covers = |at: DVec2| at.x + at.y < 70.0;
        let (out, _) = resampled(|at| if covers(at) { [200, 255, 255] } else { [0, 0, 0] });
        let (alpha, mask) = (out.alpha.as_ref().unwrap(), out.mask.as_ref().unwrap());
        assert!(alpha == mask && alpha.contains(&0) && alpha.contains(&255));
        for (pixel, alpha) in out.rgb.chunks_exact(3).zip(alpha) {
            assert!(*alpha == 0 || pixel == [200; 3], "{pixel:?} {alpha}");
        }
        let (out, _) = resampled(|at| if covers(at) { [200, 255, 255] } else { [0, 0, 255] });
        let (alpha, mask) = (out.alpha.unwrap(), out.mask.unwrap());
        assert!(mask.iter().all(|&weight| weight == 255));
        for (pixel, alpha) in out.rgb.chunks_exact(3).zip(&alpha) {
            assert!(*alpha == 0 || pixel == [200; 3], "{pixel:?} {alpha}");
        }
    }
}
