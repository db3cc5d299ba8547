//! Masks of photographs: decoding them, and hiding pixels.

use image::{DynamicImage, GrayImage};

use super::LoadError;
use super::images::{ImageHeader, SourceFile, decode, decode_checked};
use super::options::MaskMode;
use densify_core::image::Image8;
use densify_core::image::resample;

/// A mask: a greyscale image whose values become weights of pixels in the loss, or transparency.
#[derive(Debug, Clone)]
pub struct Mask {
    /// The image file.
    pub file: SourceFile,
    /// The values that hide a pixel.
    pub hides: Hides,
    /// The meaning of hidden pixels.
    pub mode: MaskMode,
}

/// The values of a mask that hide a pixel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Hides {
    /// Black hides a pixel completely, grey in part.
    Black,
    /// White hides a pixel completely, grey in part.
    White,
    /// Every value but black hides a pixel completely.
    AllButBlack,
}

impl Mask {
    /// Decodes the mask at its own size; weight 0 hides a pixel. `check` sees the header first and may refuse it.
    ///
    /// The decoded mask is not kept: masks of all photographs together would exceed the planned memory.
    pub(super) fn read_weights(
        &self,
        check: impl FnOnce(ImageHeader) -> Result<(), LoadError>,
    ) -> Result<GrayImage, LoadError> {
        Ok(self.weights(decode_checked(&self.file, check)?))
    }

    fn weights(&self, decoded: DynamicImage) -> GrayImage {
        let mut mask = values(decoded);
        match self.hides {
            Hides::Black => {}
            Hides::White => mask.iter_mut().for_each(|weight| *weight = 255 - *weight),
            Hides::AllButBlack => {
                mask.iter_mut().for_each(|weight| *weight = if *weight == 0 { 255 } else { 0 });
            }
        }
        mask
    }

    /// Hides the masked pixels of a photograph, whose size may differ from that of the mask.
    pub(super) fn apply(&self, image: &mut Image8) -> Result<(), LoadError> {
        let mask = self.weights(decode(&self.file)?);
        if mask.iter().all(|&weight| weight == 0) {
            let (path, problem) = (&self.file.path, "the mask hides every pixel");
            let remedy = "repair it, or remove the photograph and its pose";
            return Err(LoadError::malformed(path, "the mask", problem, remedy));
        }
        let size = (image.width, image.height);
        let mask = if mask.dimensions() == size {
            mask.into_raw()
        } else {
            resample::shrink_channel(mask.as_raw(), mask.dimensions(), size)
        };
        match self.mode {
            MaskMode::Ignore => image.mask = Some(mask),
            MaskMode::Background => image.alpha = masked_alpha(image.alpha.take(), mask),
        }
        Ok(())
    }
}

/// The values of a mask. If no value exceeds 1, the mask consists of 0 and 1, as Boolean arrays are often saved, and 1
/// counts as 255.
fn values(mask: DynamicImage) -> GrayImage {
    let mut values = match mask {
        // Conversion to eight bits would turn 1 into 0.
        DynamicImage::ImageLuma16(deep) if deep.iter().all(|&value| value <= 1) => {
            GrayImage::from_fn(deep.width(), deep.height(), |x, y| [deep[(x, y)].0[0] as u8].into())
        }
        mask => brightness_or_alpha(mask),
    };
    if values.iter().all(|&value| value <= 1) {
        values.iter_mut().for_each(|value| *value *= 255);
    }
    values
}

/// The brightness of a mask, or its alpha channel if only that varies.
fn brightness_or_alpha(mask: DynamicImage) -> GrayImage {
    if !mask.color().has_alpha() {
        return mask.into_luma8();
    }
    let both = mask.into_luma_alpha8();
    let channel = |number: usize| {
        GrayImage::from_fn(both.width(), both.height(), |x, y| [both[(x, y)].0[number]].into())
    };
    let [luma, alpha] = [0, 1].map(channel);
    let is_one_colour = luma.iter().all(|value| Some(value) == luma.first());
    let is_opaque = alpha.iter().all(|&value| value == 255);
    if is_one_colour && !is_opaque { alpha } else { luma }
}

/// The product of an alpha channel and a mask; `None` if all pixels are opaque.
fn masked_alpha(alpha: Option<Vec<u8>>, mut mask: Vec<u8>) -> Option<Vec<u8>> {
    for (m, a) in mask.iter_mut().zip(alpha.iter().flatten()) {
        *m = ((u32::from(*m) * u32::from(*a) + 127) / 255) as u8;
    }
    mask.iter().any(|&m| m < 255).then_some(mask)
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use image::{ImageBuffer, RgbImage};

    use super::*;
    use crate::dataset::images::ImageSource;

    #[test]
    fn a_mask_of_another_size_is_scaled_to_its_photograph_and_shrunk_with_it() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        RgbImage::from_pixel(4, 4, [10, 20, 30].into()).save(&path).unwrap();
        let mask = folder.path().join("m.png");
        GrayImage::from_fn(8, 8, |x, _| [if x < 4 { 0 } else { 255 }].into()).save(&mask).unwrap();
        let mask = Some(mask_of(mask, Hides::Black));
        let source = ImageSource { mask, width: 2, height: 2, ..ImageSource::whole(path) };
        let loaded = source.load().unwrap();
        assert_eq!(loaded.mask, Some(vec![0, 255, 0, 255]));
        assert_eq!(loaded.rgb, [10, 20, 30].repeat(4));
        assert_eq!(loaded.bytes(), source.loaded_bytes());
        assert!(source.working_bytes() >= 4 * 4 * 4 + loaded.bytes());
    }

    fn mask_of(path: PathBuf, hides: Hides) -> Mask {
        Mask { file: SourceFile::existing(path).unwrap(), hides, mode: MaskMode::Ignore }
    }

    /// Masked pixels and transparent pixels of the photograph are both transparent.
    #[test]
    fn in_background_mode_masked_pixels_are_transparent() {
        let folder = tempfile::tempdir().unwrap();
        let [path, plain, mask] = ["a.png", "b.png", "m.png"].map(|name| folder.path().join(name));
        let alpha = |x, _| image::Rgba([10_u8, 20, 30, if x == 0 { 102 } else { 255 }]);
        ImageBuffer::from_fn(2, 2, alpha).save(&path).unwrap();
        RgbImage::from_pixel(2, 2, [10, 20, 30].into()).save(&plain).unwrap();
        GrayImage::from_fn(2, 2, |_, y| [if y == 0 { 0 } else { 255 }].into()).save(&mask).unwrap();
        for (path, hides, expected) in [
            (&path, Hides::Black, Some(vec![0, 0, 102, 255])),
            (&path, Hides::White, Some(vec![102, 255, 0, 0])),
            (&plain, Hides::Black, Some(vec![0, 0, 255, 255])),
        ] {
            let mask = Some(Mask { mode: MaskMode::Background, ..mask_of(mask.clone(), hides) });
            let source = ImageSource { mask, ..ImageSource::whole(path.clone()) };
            let loaded = source.load().unwrap();
            assert_eq!((&loaded.alpha, &loaded.mask), (&expected, &None), "{hides:?}");
            assert!(!source.is_masked());
            assert_eq!(loaded.bytes(), source.loaded_bytes());
        }
    }

    /// The alpha channel counts only if all pixels have the same brightness.
    #[test]
    fn a_mask_may_be_an_alpha_channel() {
        let read = |pixels: [[u8; 2]; 2]| {
            let image = image::GrayAlphaImage::from_fn(2, 1, |x, _| pixels[x as usize].into());
            values(image.into()).into_raw()
        };
        assert_eq!(read([[0, 0], [0, 255]]), [0, 255]);
        assert_eq!(read([[255, 255], [255, 90]]), [255, 90]);
        assert_eq!(read([[0, 0], [255, 255]]), [0, 255]);
        assert_eq!(read([[0, 255], [255, 0]]), [0, 255], "brightness");
        assert_eq!(read([[7, 255], [7, 255]]), [7, 7]);
    }

    /// 1 counts as 255 only if no value exceeds it.
    #[test]
    fn a_mask_may_consist_of_0_and_1() {
        let read = |pixels: [u8; 3]| {
            let image = GrayImage::from_fn(3, 1, |x, _| [pixels[x as usize]].into());
            values(image.into()).into_raw()
        };
        assert_eq!(read([0, 1, 1]), [0, 255, 255]);
        assert_eq!(read([1, 1, 1]), [255; 3]);
        assert_eq!(read([0, 1, 2]), [0, 1, 2]);
        assert_eq!(read([0, 0, 0]), [0; 3]);
        let deep = |largest: u16| {
            let image = ImageBuffer::from_fn(2, 1, |x, _| image::Luma([x as u16 * largest]));
            values(image.into()).into_raw()
        };
        assert_eq!(deep(1), [0, 255]);
        assert_eq!(deep(65_535), [0, 255]);
        assert_eq!(deep(257), [0, 255], "1 in eight bits");
    }

    #[test]
    fn a_mask_that_hides_everything_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let [path, mask] = ["a.png", "m.png"].map(|name| folder.path().join(name));
        RgbImage::from_pixel(4, 4, [10, 20, 30].into()).save(&path).unwrap();
        for (colour, hides) in [(0, Hides::Black), (255, Hides::White), (1, Hides::AllButBlack)] {
            GrayImage::from_pixel(4, 4, [colour].into()).save(&mask).unwrap();
            let mask = Some(mask_of(mask.clone(), hides));
            let source = ImageSource { mask, ..ImageSource::whole(path.clone()) };
            let error = source.load().unwrap_err().to_string();
            assert!(error.contains("m.png") && error.contains("hides every pixel"), "{error}");
        }
    }
}
