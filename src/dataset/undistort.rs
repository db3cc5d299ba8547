//! Resampling from a lens to a pinhole that sees a part of what it saw.

use glam::{DMat3, DVec2, DVec3};

use super::lens::Lens;
use super::pixels::Image8;
use super::resample::PixelMean;

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

    /// Resamples an image of the lens, bilinearly, in one row-major pass.
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
                    let (x0, y0) = (at.x as u32, at.y as u32);
                    let (x1, y1) = ((x0 + 1).min(image.width - 1), (y0 + 1).min(image.height - 1));
                    let (tx, ty) = ((at.x - f64::from(x0)) as f32, (at.y - f64::from(y0)) as f32);
                    mean.add(image, x0, y0, (1.0 - tx) * (1.0 - ty));
                    mean.add(image, x1, y0, tx * (1.0 - ty));
                    mean.add(image, x0, y1, (1.0 - tx) * ty);
                    mean.add(image, x1, y1, tx * ty);
                }
                mean.push_to(&mut out);
            }
        }
        out
    }
}
