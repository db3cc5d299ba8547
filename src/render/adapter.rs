//! Descriptions of graphics adapters, also compiled into programs without the GPU backend.

use super::Accumulation;

/// Kinds of adapters.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AdapterKind {
    /// A graphics card.
    Discrete,
    /// Graphics that share the processor's memory.
    Integrated,
    /// A GPU assigned to a virtual machine.
    Virtual,
    /// A software driver.
    Software,
    /// Not reported by the driver.
    Unknown,
}

/// An adapter with its relevant limits.
#[derive(Debug, Clone, PartialEq)]
pub struct AdapterSummary {
    /// The name that the driver reports.
    pub name: String,
    /// The interface: vulkan, metal, dx12.
    pub interface: String,
    /// The driver and its version.
    pub driver: String,
    /// The kind of adapter.
    pub kind: AdapterKind,
    /// Largest buffer that a kernel can bind `[bytes]`.
    pub largest_binding: u64,
    /// Largest buffer that can be allocated `[bytes]`.
    pub largest_buffer: u64,
    /// Features and limits that the kernels need and the adapter lacks; empty if it is usable.
    pub missing: Vec<String>,
    /// The supported methods of accumulating gradients, the fastest last; [`Accumulation::Slots`] is always supported.
    pub accumulations: Vec<Accumulation>,
}

impl AdapterSummary {
    /// The default method of accumulating gradients: the fastest one supported.
    pub fn accumulation(&self) -> Accumulation {
        self.accumulations.last().copied().unwrap_or(Accumulation::Slots)
    }

    /// True if the adapter may be chosen automatically: it is usable and not a software driver.
    pub fn is_gpu(&self) -> bool {
        self.kind != AdapterKind::Software && self.missing.is_empty()
    }
}

/// The requested adapter.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct AdapterChoice {
    /// Part of the name of the adapter or its driver, case-insensitive; `None` selects the best adapter.
    pub name: Option<String>,
    /// The method of accumulating gradients; `None` selects the adapter's [default](AdapterSummary::accumulation).
    pub accumulation: Option<Accumulation>,
}
