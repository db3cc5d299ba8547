//! Stands in for the GPU backend in programs built without the feature `gpu`: it finds no adapter.

use densify_policies::policy::Needs;

use super::{
    Accumulation, AdapterChoice, AdapterSummary, BackendError, Differentiable, Setup, Storage,
};
use densify_core::gaussians::Gaussians;
use densify_core::memory::Ledger;

/// An open device, which cannot exist without the GPU backend.
#[derive(Debug, Clone)]
pub enum GpuDevice {}

#[expect(missing_docs, clippy::missing_errors_doc, reason = "as with the feature `gpu`")]
impl GpuDevice {
    pub fn open(_: &AdapterChoice) -> Result<Self, BackendError> {
        Err(BackendError::WithoutGpu)
    }

    pub fn adapter(&self) -> &AdapterSummary {
        match *self {}
    }

    pub fn accumulation(&self) -> Accumulation {
        match *self {}
    }

    pub(super) fn largest_budget(&self, _: u8) -> u64 {
        match *self {}
    }

    pub(super) fn max_pairs(&self, _: &Needs, _: bool) -> u64 {
        match *self {}
    }

    pub(super) fn memory_plan(&self, _: u8, _: &Setup) -> Ledger {
        match *self {}
    }

    pub(super) fn run_canary(&self, _: &Needs, _: Storage, _: bool) -> Result<(), BackendError> {
        match *self {}
    }

    pub fn backend(
        &self,
        _: &Gaussians,
        _: &Setup,
    ) -> Result<Box<dyn Differentiable>, BackendError> {
        match *self {}
    }
}

/// All adapters; there are none.
pub fn adapters() -> Vec<AdapterSummary> {
    Vec::new()
}

/// False: without the GPU backend no GPU can be used.
pub(super) fn may_be_present() -> bool {
    false
}
