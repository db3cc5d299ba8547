//! The uniform buffer that all stages read and the scalars that they return: the Rust side of
//! `shaders/shared/view.wgsl`. A test compares the layouts.

use bytemuck::{Pod, Zeroable};
use densify_policies::policy::{ErrorScore, Signal};

use crate::cpu::{SSIM_WEIGHT, ViewParams};
use crate::signals::SignalPlanes;
use crate::{StepInput, StepOutput, TILE};
use densify_core::antialiasing::Antialiasing;
use densify_core::camera::Camera;

/// See `Frame` in `shaders/shared/view.wgsl`.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Frame {
    pub(super) rotation: [[f32; 4]; 3],
    pub(super) centre: [f32; 4],
    pub(super) lens: [f32; 4],
    pub(super) ratio: [f32; 4],
    pub(super) background: [f32; 4],
    pub(super) image: [u32; 4],
    pub(super) model: [u32; 4],
    pub(super) rates: [f32; 4],
    pub(super) more_rates: [f32; 4],
    pub(super) noise: [f32; 4],
    pub(super) score: [f32; 4],
    pub(super) errors: [f32; 4],
    pub(super) draw: [u32; 4],
    pub(super) frozen: [u32; 4],
    pub(super) planes: [[u32; 4]; 8],
}

/// See `State` in `shaders/shared/view.wgsl`; the limits of the bands follow in the same buffer.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub(super) struct State {
    pub(super) visible: u32,
    pub(super) total: u32,
    pub(super) bands: u32,
    pub(super) short: u32,
    pub(super) entries_low: u32,
    pub(super) entries_high: u32,
    pub(super) held: u32,
    pub(super) broken_off: u32,
    pub(super) l1: f32,
    pub(super) ssim: f32,
    pub(super) depth: f32,
    pub(super) spare_f: f32,
}

impl State {
    /// Number of (row, tile) pairs of all bands.
    pub(super) fn entries(&self) -> u64 {
        u64::from(self.entries_high) << 32 | u64::from(self.entries_low)
    }

    /// The output of a step.
    pub(super) fn output(&self) -> StepOutput {
        let Self { l1, ssim, visible, bands, .. } = *self;
        StepOutput {
            loss: (1.0 - SSIM_WEIGHT) * l1 + SSIM_WEIGHT * (1.0 - ssim),
            l1,
            ssim,
            visible: visible as usize,
            entries: self.entries(),
            bands,
            exposure: None,
            pose: None,
            vignette: None,
            depth: None,
        }
    }
}

/// Bits of `Frame::draw[2]`: parameter groups that step, groups with waiting gradients, whether bands 1–3 have their
/// own ages, and the terms that a policy adds.
pub(super) mod due {
    pub(in super::super) const MAIN_STEPS: u32 = 1;
    pub(in super::super) const REST_STEPS: u32 = 2;
    pub(in super::super) const MAIN_WAITED: u32 = 4;
    pub(in super::super) const REST_WAITED: u32 = 8;
    pub(in super::super) const REST_AGES: u32 = 16;
    pub(in super::super) const TERMS: u32 = 32;
    pub(in super::super) const NOISE: u32 = 64;
}

/// Bits of `Frame::draw[3]`: planes that the target has, whether the error per pixel is written for candidates and for
/// signals, whether there is an exposure, and what `shaders/shared/view.wgsl` says about depth.
pub(super) mod target {
    pub(in super::super) const HAS_ALPHA: u32 = 1;
    pub(in super::super) const HAS_MASK: u32 = 2;
    pub(in super::super) const WITH_ERROR: u32 = 4;
    pub(in super::super) const BY_PIXEL: u32 = 8;
    pub(in super::super) const EXPOSED: u32 = 16;
    pub(in super::super) const INVERSE_DEPTH: u32 = 32;
    pub(in super::super) const DEPTH_DISTANCES: u32 = 64;
    pub(in super::super) const GIVEN_DEPTH: u32 = 128;
}

const _: () = assert!(Signal::ALL.len() <= 4 * 8, "`Frame::planes` has an element for each signal");

/// Number of columns and of tiles of an image.
pub(super) fn grid(width: u32, height: u32) -> [u32; 2] {
    let columns = width.div_ceil(TILE);
    [columns, columns * height.div_ceil(TILE)]
}

impl Frame {
    /// The frame of a view, without an optimiser step.
    pub(super) fn for_view(
        camera: &Camera,
        background: [f32; 3],
        near: f32,
        [rows, sh_degree, cap, trained]: [u32; 4],
    ) -> Self {
        // The kernels have the antialiasing as constants.
        let view = ViewParams::new(camera, near, sh_degree as u8, Antialiasing::None);
        let row = |i: usize| {
            let [x, y, z] = view.rotation[i];
            [x, y, z, view.translation[i]]
        };
        let pairs = |[a, b]: [f32; 2], [c, d]: [f32; 2]| [a, b, c, d];
        let [x, y, z] = view.centre;
        let [columns, tiles] = grid(camera.width, camera.height);
        let [r, g, b] = background;
        Self {
            rotation: [row(0), row(1), row(2)],
            centre: [x, y, z, near],
            lens: pairs(view.focal, view.principal),
            ratio: pairs(view.ratio_min, view.ratio_max),
            background: [r, g, b, 0.0],
            image: [camera.width, camera.height, columns, tiles],
            model: [rows, sh_degree, cap, trained],
            ..Self::zeroed()
        }
    }

    /// Adds the values of an optimiser step of `trained` rows.
    pub(super) fn add_step(
        &mut self,
        input: &StepInput<'_>,
        trained: f32,
        due: u32,
        planes: &SignalPlanes,
    ) {
        let StepInput { rates, loss_terms: terms, noise, .. } = input;
        self.rates = [rates.mean, rates.log_scale, rates.quat, rates.opacity];
        self.more_rates =
            [rates.sh_dc, rates.sh_rest, terms.opacity / trained, terms.scale / (3.0 * trained)];
        if let Some(noise) = noise {
            self.noise = [noise.strength * rates.noise, noise.sharpness, noise.opacity, 0.0];
        }
        let adds = (if terms.is_none() { 0 } else { due::TERMS })
            | (if noise.is_some() { due::NOISE } else { 0 });
        self.draw = [folded_seed(input.seed), input.step, due | adds, self.draw[3]];
        self.background[3] = planes.full_depth;
        let ErrorScore { power, edge, footprint, view_power, .. } = planes.score;
        self.score = [power, edge, footprint, view_power];
        // Plane of each signal that the view adds to.
        for (signal, plane) in Signal::ALL.into_iter().zip(self.planes.as_flattened_mut()) {
            *plane = planes.current(signal).map_or(u32::MAX, |plane| plane as u32);
        }
    }
}

/// The seed folded to 32 bits; see `PolicyRng::new`.
pub(super) fn folded_seed(seed: u64) -> u32 {
    (seed ^ (seed >> 32).wrapping_mul(0x9e37_79b9)) as u32
}
