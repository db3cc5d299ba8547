//! Resampling from a lens to a pinhole that sees a part of what it saw.

use glam::{DMat3, DVec2, DVec3};

use super::lens::Lens;
use densify_core::image::Image8;
use densify_core::resample::PixelMean;
use densify_core::spline::catmull_rom;

/// A camera's image without distortion. The upper left corner is (0, 0); pixel centres are at +0.5.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pinhole {
    /// Image width `[px]`.
    pub width: u32,
    /// Image height `[px]`.
    pub height: u32,
    /// Focal lengths `[px]`.
    pub focal: DVec2,
    /// Principal point `[px]`.
    pub principal: DVec2,
}

/// How to resample an image of a lens to a pinhole's.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Undistortion {
    /// The lens that took the image, at the image's size.
    from: Lens,
    to: Pinhole,
    lens_from_pinhole: DMat3,
    /// Whether the lens did not see all of the pinhole's image; the rest is masked.
    masked: bool,
}

impl Undistortion {
    pub(super) fn new(from: Lens, to: Pinhole, lens_from_pinhole: DMat3, masked: bool) -> Self {
        Self { from, to, lens_from_pinhole, masked }
    }

    /// The pinhole resampled to.
    #[must_use]
    pub fn pinhole(&self) -> &Pinhole {
        &self.to
    }

    /// From the pinhole's axes to the lens's.
    #[must_use]
    pub fn lens_from_pinhole(&self) -> DMat3 {
        self.lens_from_pinhole
    }

    /// Whether its images have a mask of what the lens saw.
    #[must_use]
    pub fn is_masked(&self) -> bool {
        self.masked
    }

    /// Whether a ray of the lens falls into the pinhole's image.
    pub(super) fn shows(&self, ray: DVec3) -> bool {
        let ray = self.lens_from_pinhole.transpose() * ray;
        let at = ray.truncate() / ray.z * self.to.focal + self.to.principal;
        let size = DVec2::new(f64::from(self.to.width), f64::from(self.to.height));
        // The rim of a lens is within rounding of the pinhole's.
        ray.z > 0.0 && (at.cmpge(DVec2::splat(-1e-6)) & at.cmple(size + 1e-6)).all()
    }

    /// Position in the lens's image of a place in the pinhole's `[px]`; `None` where the lens saw nothing.
    #[must_use]
    pub fn source_of(&self, pixel: DVec2) -> Option<DVec2> {
        let p = (pixel - self.to.principal) / self.to.focal;
        let ray = self.lens_from_pinhole * p.extend(1.0);
        if !self.masked {
            // Seen by construction; on the rim rounding must not make a hole.
            return self.from.extrapolate(ray);
        }
        let is_in_image = |at: &DVec2| (at.cmpge(DVec2::ZERO) & at.cmple(self.from.size())).all();
        self.from.project(ray).filter(is_in_image)
    }

    /// Resamples an image of the lens in one row-major pass.
    ///
    /// Bicubically: bilinear means blur, which cost half a dB of test views (docs/data.md). Where a mask hides a
    /// pixel nearby it is bilinear all the same, so that nothing hidden reaches what counts.
    #[must_use]
    pub fn apply(&self, image: &Image8) -> Image8 {
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
                // Within half a pixel of the border its pixels are repeated.
                if let Some(at) = source {
                    let at = (at - 0.5).clamp(DVec2::ZERO, last);
                    let [columns, rows] =
                        [Stencil::of(at.x, image.width), Stencil::of(at.y, image.height)];
                    let hides = |mask: &Vec<u8>| {
                        let row = |y: u32| y as usize * image.width as usize;
                        let hidden = |x: u32, y: u32| mask[row(y) + x as usize] < 255;
                        rows.places.iter().any(|&y| columns.places.iter().any(|&x| hidden(x, y)))
                    };
                    let weights = match image.mask.as_ref().is_some_and(hides) {
                        true => [columns.linear(), rows.linear()],
                        false => [columns.cubic(), rows.cubic()],
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

/// The four pixels around a place along one axis.
struct Stencil {
    /// Those beyond the border are the one at the border.
    places: [u32; 4],
    /// How far the place is from the second pixel to the third.
    t: f32,
}

impl Stencil {
    /// Of a place between the centres of the first and of the last pixel.
    fn of(at: f64, side: u32) -> Self {
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
    use super::super::lens::{Cut, Distortion, Plane};
    use super::*;

    const SIZE: (u32, u32) = (90, 60);

    /// A fisheye's image with these channels at each pixel centre, and what becomes of it.
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
        let lens = Lens::new(SIZE, focal, middle, Distortion::of(Plane::Equidistant));
        Cut::of(&lens, false).unwrap().faces[0].1
    }

    fn centre(out: &Image8, index: usize) -> DVec2 {
        let (x, y) = (index as u32 % out.width, index as u32 / out.width);
        DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5)
    }

    /// A wave of 5 px, which bilinear means flatten by up to a fifth.
    #[test]
    fn what_is_sharp_stays_so() {
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

    /// Beside an edge a cubic leaves the range of its pixels, which must not become another colour; and the
    /// border's pixels go on beyond it.
    #[test]
    fn an_edge_has_no_other_colours_and_the_border_none_of_its_own() {
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
    fn beyond_the_border_are_the_pixels_at_it() {
        for (at, places) in [
            (0.2, [0, 0, 1, 2]),
            (5.5, [4, 5, 6, 7]),
            (88.5, [87, 88, 89, 89]),
            (89.0, [88, 89, 89, 89]),
        ] {
            assert_eq!(Stencil::of(at, 90).places, places, "{at}");
        }
    }

    #[test]
    fn hidden_pixels_reach_no_pixel_that_counts() {
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
            // A pixel counts as far as what it shows does.
            let most = f64::from(255 - weight) + 1.0;
            assert!(f64::from(a.abs_diff(b)) <= most, "{a} {b} {weight}");
            counted += usize::from(weight == 255);
        }
        assert!(counted > 4000 && dark.mask.unwrap().contains(&0));
    }

    /// A mask is resampled as a photograph would be bilinearly.
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
