//! Depth in the loss on the device: uploads what is given before a view's passes.

use super::GpuBackend;
use super::frame::{Frame, target};
use crate::StepInput;
use crate::depth::{DepthLoss, DepthTerm, confidence_in};

impl GpuBackend {
    /// The depth in the loss of a step, if there is any: uploads the given depth and sets its numbers in the frame.
    pub(super) fn load_depth<'a>(
        &self,
        frame: &mut Frame,
        input: &StepInput<'a>,
    ) -> Option<DepthLoss<'a>> {
        let loss = DepthLoss::new(input, self.near, self.sizes.depth, |map, mask| {
            confidence_in(map, mask, 0..map.inverse.len())
        })?;
        // Gradients of alpha and depth replace the channel once `differentiate` has been called.
        assert!(!self.sizes.alpha_and_depth, "a step with depth after a differentiation");
        frame.draw[3] |= target::INVERSE_DEPTH;
        if let Some(map) = loss.map {
            frame.draw[3] |= target::GIVEN_DEPTH;
            let by_alpha = match loss.term {
                DepthTerm::Expected => 0.0,
                DepthTerm::Samples => -loss.by_transmittance / loss.by_distance,
            };
            if loss.term == DepthTerm::Samples {
                frame.draw[3] |= target::DEPTH_DISTANCES;
            }
            let by_alpha = if by_alpha.is_finite() { by_alpha } else { 0.0 };
            let numbers = [map.unit, map.median, by_alpha];
            frame.frozen[1..].copy_from_slice(&numbers.map(f32::to_bits));
            let mask = |pixel: usize| loss.mask.map_or(255, |mask| u32::from(mask[pixel]));
            let word = |(pixel, (&inverse, &confidence)): (usize, (&u16, &u8))| {
                let weight = u32::from(confidence) * mask(pixel);
                if inverse == 0 || weight == 0 { 0 } else { u32::from(inverse) | weight << 16 }
            };
            let pixels = map.inverse.iter().zip(&map.confidence).enumerate();
            let words: Vec<u32> = pixels.map(word).collect();
            self.write("given depth", bytemuck::cast_slice(&words));
        }
        Some(loss)
    }
}
