//! The device's buffers: every size is known before the first is allocated, and the ledger is the
//! list of them. All have the size of the budget, the tile cap or the largest image from the start.

use std::collections::HashMap;

use densify_policies::policy::{Cadence, ErrorMode, Needs};
use wgpu::{Buffer, BufferDescriptor, BufferUsages};

use super::accumulation::Accumulation;
use super::device::Device;
use super::frame::{Frame, State, grid};
use super::photographs::KeptPhotographs;
use super::signals::{Planes, record_stride};
use crate::backend::BackendError;
use crate::gaussians::sh_coefficients;
use crate::memory::{Ledger, Section};

/// Operations of an edit that are uploaded at a time `[bytes]`.
pub(super) const OPS_BYTES: u64 = 1 << 18;
/// What is read back at a time `[bytes]`.
pub(super) const READ_BYTES: u64 = 1 << 20;
/// Items per group of the sums and sorts; see `shaders/tiles.wgsl`.
pub(super) const BLOCK: u64 = 2048;
/// Ages at which the bias correction is tabulated; older rows have none left: ln(2⁻²⁵)/ln(0.999).
pub(super) const MATURE: usize = 17_400;
/// Most entries at a time: sums saturate beyond it.
pub(super) const MOST_ENTRIES: u64 = 1 << 28;

/// Coefficients of a band, per channel.
pub(super) const fn band_coefficients(band: usize) -> usize {
    2 * band + 1
}

/// The colour bands of parameters, both moments, and gradients that wait.
pub(super) const SH: [&str; 4] = ["sh0", "sh1", "sh2", "sh3"];
pub(super) const FIRST_SH: [&str; 4] = ["first sh0", "first sh1", "first sh2", "first sh3"];
pub(super) const SECOND_SH: [&str; 4] = ["second sh0", "second sh1", "second sh2", "second sh3"];
pub(super) const WAITING_SH: [&str; 4] =
    ["waiting sh0", "waiting sh1", "waiting sh2", "waiting sh3"];

/// What decides all sizes.
#[derive(Debug, Clone)]
pub(super) struct Sizes {
    pub(super) budget: u64,
    pub(super) cap: u64,
    pub(super) sh_degree: u8,
    pub(super) image: (u32, u32),
    pub(super) photographs: KeptPhotographs,
    pub(super) planes: u64,
    /// Records and their sums.
    pub(super) detail: u32,
    /// How sums come about: whether there are records at all.
    pub(super) accumulation: Accumulation,
    /// Whether the gradients of alpha and depth are given, too.
    pub(super) more: bool,
    pub(super) cadence: Cadence,
    pub(super) with_error: bool,
}

/// One buffer to be.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Planned {
    pub(super) name: &'static str,
    pub(super) section: Section,
    pub(super) what: &'static str,
    pub(super) bytes: u64,
    usage: BufferUsages,
}

impl Sizes {
    pub(super) fn new(
        budget: usize,
        cap: u64,
        sh_degree: u8,
        image: (u32, u32),
        needs: &Needs,
        accumulation: Accumulation,
    ) -> Self {
        let planes = Planes::new(needs);
        Self {
            budget: budget as u64,
            cap,
            sh_degree,
            image,
            photographs: KeptPhotographs::default(),
            planes: u64::from(planes.count),
            detail: planes.detail,
            accumulation,
            more: false,
            cadence: needs.cadence,
            with_error: needs.candidates.is_some_and(|r| r.error != ErrorMode::Gradient),
        }
    }

    /// Whether the gradients of the geometry and of band 0, and those of bands 1–3, may wait.
    pub(super) fn waits(&self) -> [bool; 2] {
        let Cadence { all, sh_rest } = self.cadence;
        [all > 1, all > 1 || sh_rest > 1]
    }

    /// Every buffer.
    pub(super) fn planned(&self) -> Vec<Planned> {
        let storage = BufferUsages::STORAGE | BufferUsages::COPY_SRC | BufferUsages::COPY_DST;
        let mut all = Vec::new();
        let mut add = |section, what, name, bytes: u64| {
            let bytes = bytes.max(16).next_multiple_of(16);
            all.push(Planned { name, section, what, bytes, usage: storage });
        };
        let (b, cap) = (self.budget, self.cap);
        let bands = usize::from(self.sh_degree) + 1;
        let band = |i: usize| b * 12 * band_coefficients(i) as u64;
        let [main_waits, rest_waits] = self.waits();
        add(Section::Model, "parameters", "rows", 48 * b);
        add(Section::Model, "optimiser moments", "first rows", 48 * b);
        add(Section::Model, "optimiser moments", "second rows", 48 * b);
        for i in 0..bands {
            add(Section::Model, "parameters", SH[i], band(i));
            add(Section::Model, "optimiser moments", FIRST_SH[i], band(i));
            add(Section::Model, "optimiser moments", SECOND_SH[i], band(i));
            if if i == 0 { main_waits } else { rest_waits } {
                add(Section::Gradients, "gradients summed between steps", WAITING_SH[i], band(i));
            }
        }
        if main_waits {
            add(Section::Gradients, "gradients summed between steps", "waiting rows", 48 * b);
        }
        add(Section::Model, "optimiser ages and bias tables", "ages", 4 * b);
        add(Section::Model, "optimiser ages and bias tables", "bias", 8 * (MATURE as u64 + 1));
        add(Section::Policy, "signals", "signals", 4 * b * self.planes);
        add(Section::Renderer, "projected splats", "splats", 48 * b);
        add(Section::Renderer, "projected splats", "footprints", 16 * b);
        add(Section::Renderer, "projected splats", "depths", 4 * b);
        add(Section::Renderer, "projected splats", "order", 4 * b);
        add(Section::Renderer, "projected splats", "slots of row", 8 * b);
        let stride = 4 * record_stride(self.detail);
        add(Section::Gradients, "splat gradients", "row sums", stride * b);
        add(Section::Gradients, "row gradients", "gradient", 80 * b);
        for name in ["keys 0", "keys 1", "values 0", "values 1", "row of slot"] {
            add(Section::Tiles, "entries", name, 4 * cap);
        }
        if self.accumulation == Accumulation::Slots {
            add(Section::Tiles, "gradients per entry", "records", stride * cap);
        }
        let sums = b.max(16 * cap.div_ceil(BLOCK));
        add(Section::Tiles, "sums", "sums", 4 * sums);
        add(Section::Tiles, "sums", "block sums", 4 * sums.div_ceil(BLOCK));
        let (width, height) = self.image;
        let pixels = u64::from(width) * u64::from(height);
        let tiles = u64::from(grid(width, height)[1]);
        add(Section::Tiles, "tiles", "state", size_of::<State>() as u64 + 4 * (tiles + 2));
        add(Section::Tiles, "tiles", "tile starts", 4 * (tiles + 1));
        add(Section::Tiles, "tiles", "tile counts", 4 * tiles);
        add(Section::Renderer, "image and image gradient", "canvas", 16 * pixels);
        add(Section::Renderer, "image and image gradient", "finish", 8 * pixels);
        let channels = if self.more { 5 } else { 3 };
        add(Section::Renderer, "image and image gradient", "pixel gradient", 4 * channels * pixels);
        add(Section::Renderer, "loss", "derivatives", 36 * pixels);
        add(Section::Renderer, "loss", "tile sums", 8 * tiles);
        if self.with_error {
            add(Section::Renderer, "loss", "error", 4 * pixels);
        }
        add(Section::Images, "photograph on the device", "truth", 4 * pixels);
        add(Section::Images, "photograph on the device", "mask", pixels.next_multiple_of(4));
        let kept = self.photographs.count as u64 * self.photograph_bytes().iter().sum::<u64>();
        if kept > 0 {
            add(Section::Images, "photographs kept on the device", "photographs", kept);
        }
        add(Section::Policy, "operations of an edit", "ops", OPS_BYTES);
        add(Section::Renderer, "small buffers", "nothing", 16);
        add(Section::Renderer, "small buffers", "selection", 4 * (4 + 256));
        let mut add_as = |section, what, name, bytes, usage| {
            all.push(Planned { name, section, what, bytes, usage });
        };
        add_as(
            Section::Renderer,
            "small buffers",
            "frame",
            size_of::<Frame>() as u64,
            BufferUsages::UNIFORM | BufferUsages::COPY_DST,
        );
        add_as(
            Section::Renderer,
            "small buffers",
            "groups",
            64,
            BufferUsages::STORAGE | BufferUsages::INDIRECT,
        );
        add_as(
            Section::Renderer,
            "copies to the host",
            "read",
            READ_BYTES,
            BufferUsages::MAP_READ | BufferUsages::COPY_DST,
        );
        all
    }

    /// Bytes per purpose.
    pub(super) fn ledger(&self) -> Ledger {
        let mut ledger = Ledger::default();
        for Planned { section, what, bytes, .. } in self.planned() {
            ledger.add_on_device(section, what, bytes);
        }
        ledger
    }

    /// Numbers per row of all parameters but the geometry.
    pub(super) fn sh_numbers(&self) -> usize {
        3 * sh_coefficients(self.sh_degree)
    }
}

/// The buffers, by name.
#[derive(Debug)]
pub(super) struct Buffers {
    named: HashMap<&'static str, Buffer>,
    nothing: Buffer,
}

impl Buffers {
    /// Allocates everything, or nothing that lasts.
    pub(super) fn new(device: &Device, sizes: &Sizes) -> Result<Self, BackendError> {
        let planned = sizes.planned();
        device.check_sizes(&planned, sizes)?;
        let total = planned.iter().map(|p| p.bytes).sum();
        let named = device.guarded("the training buffers", total, |device| {
            planned
                .iter()
                .map(|p| (p.name, create(device, p)))
                .collect::<HashMap<&'static str, Buffer>>()
        })?;
        let nothing = named["nothing"].clone();
        Ok(Self { named, nothing })
    }

    /// Allocates those again whose size is another now.
    pub(super) fn resize(&mut self, device: &Device, sizes: &Sizes) -> Result<(), BackendError> {
        let planned = sizes.planned();
        device.check_sizes(&planned, sizes)?;
        let changed: Vec<_> = planned
            .into_iter()
            .filter(|p| self.named.get(p.name).is_none_or(|b| b.size() != p.bytes))
            .collect();
        for p in &changed {
            if let Some(old) = self.named.remove(p.name) {
                old.destroy();
            }
        }
        let total = changed.iter().map(|p| p.bytes).sum();
        let new = device.guarded("larger images", total, |device| {
            changed.iter().map(|p| (p.name, create(device, p))).collect::<Vec<_>>()
        })?;
        self.named.extend(new);
        Ok(())
    }

    /// The buffer of this name; a few bytes that nobody reads where there is none, such as of bands
    /// beyond the model's degree.
    pub(super) fn get(&self, name: &str) -> &Buffer {
        self.named.get(name).unwrap_or(&self.nothing)
    }

    /// What is allocated now `[bytes]`.
    pub(super) fn bytes(&self) -> u64 {
        self.named.values().map(Buffer::size).sum()
    }
}

fn create(device: &wgpu::Device, planned: &Planned) -> Buffer {
    device.create_buffer(&BufferDescriptor {
        label: Some(planned.name),
        size: planned.bytes,
        usage: planned.usage,
        mapped_at_creation: false,
    })
}

/// 1/(1 − β₁^age) and √(1/(1 − β₂^age)), by age.
pub(super) fn bias_table() -> Vec<[f32; 2]> {
    (0..=MATURE as i32)
        .map(|age| {
            let age = age.max(1);
            let first = 1.0 / (1.0 - f64::from(0.9_f32).powi(age));
            let second = 1.0 / (1.0 - f64::from(0.999_f32).powi(age));
            [first as f32, second.sqrt() as f32]
        })
        .collect()
}
