//! What is known of a GPU before it is used, whether or not this program has the GPU backend.

use super::Accumulation;

/// What an adapter is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AdapterKind {
    /// A graphics card.
    Discrete,
    /// Graphics that share the processor's memory.
    Integrated,
    /// A card that a virtual machine is lent.
    Virtual,
    /// A program on the processor.
    Software,
    /// The driver does not say.
    Unknown,
}

/// An adapter and the limits that matter.
#[derive(Debug, Clone, PartialEq)]
pub struct AdapterSummary {
    /// As the driver names it.
    pub name: String,
    /// The interface: vulkan, metal, dx12.
    pub interface: String,
    /// The driver and its version.
    pub driver: String,
    /// What it is.
    pub kind: AdapterKind,
    /// Largest buffer that a kernel can use `[bytes]`.
    pub largest_binding: u64,
    /// Largest buffer `[bytes]`.
    pub largest_buffer: u64,
    /// What it lacks to be usable; empty if it is.
    pub missing: Vec<String>,
    /// The ways of adding up gradients that it has, the fastest last; always [`Accumulation::Slots`].
    pub accumulations: Vec<Accumulation>,
}

impl AdapterSummary {
    /// How it adds up gradients by default: the fastest way it supports.
    #[must_use]
    pub fn accumulation(&self) -> Accumulation {
        self.accumulations.last().copied().unwrap_or(Accumulation::Slots)
    }

    /// Whether `auto` may take it: a GPU that lacks nothing.
    #[must_use]
    pub fn is_gpu(&self) -> bool {
        self.kind != AdapterKind::Software && self.missing.is_empty()
    }
}

/// Which adapter to take, and how it adds up gradients.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct AdapterChoice {
    /// Part of its name or its driver's, in upper or lower case; `None` takes the best.
    pub name: Option<String>,
    /// How it adds up gradients; [its own choice](AdapterSummary::accumulation) without one.
    pub accumulation: Option<Accumulation>,
}
