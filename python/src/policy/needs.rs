//! The needs of a policy as Python declares them.

use densify_policies::policy::{
    AuxRequest, Cadence, CandidateRequest, ErrorScore, LossTerms, MaskTerm, Needs, NoiseTerm,
    PixelLoss, RateOverrides, Signal, SignalSet, StartRule,
};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use serde::Deserialize;

/// Bytes per row that Python takes at an event besides its copies of the signals: masks, lists of rows, and arrays that
/// a policy computes. A score of nine signals takes 20.
const PYTHON_BYTES: usize = 32;
/// Maximum of `scratch_bytes`: with as many bytes for each row, any number of rows that fits memory is counted without
/// an overflow.
const MAX_SCRATCH_BYTES: usize = 1 << 24;

/// [`Needs`] as JSON, with the names of the Python class.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Declared {
    signals: Vec<Signal>,
    full_depth: f32,
    error_score: Option<ErrorScore>,
    candidates: Option<CandidateRequest>,
    aux: Option<AuxRequest>,
    pixel_loss: PixelLoss,
    loss_terms: Option<LossTerms>,
    noise: Option<NoiseTerm>,
    mask: Option<MaskTerm>,
    cadence: Option<Cadence>,
    least_resolution: Option<f64>,
    rates: Option<RateOverrides>,
    start: Option<StartRule>,
    detailed_edits: bool,
    scratch_bytes: usize,
}

/// The needs in the text that `densify._policy.needs_of` returns.
///
/// # Errors
/// `ValueError` when a name is unknown, or a value is missing or of another type.
pub(super) fn parse(json: &str) -> PyResult<Needs> {
    let declared: Declared = serde_json::from_str(json).map_err(|error| {
        let error = error.to_string();
        // The position in the text means nothing to the user.
        let problem = error.split(" at line ").next().unwrap_or(&error);
        PyValueError::new_err(format!("needs: {problem}"))
    })?;
    let signals: SignalSet = declared.signals.into_iter().collect();
    let columns = declared.aux.as_ref().map_or(0, |aux| aux.columns.len());
    let copies = size_of::<f32>() * (signals.width() + columns);
    if declared.scratch_bytes > MAX_SCRATCH_BYTES {
        return Err(PyValueError::new_err(format!(
            "needs: scratch_bytes is {}; it must be at most {MAX_SCRATCH_BYTES}, as it is for each row",
            declared.scratch_bytes
        )));
    }
    let needs = Needs {
        signals,
        full_depth: declared.full_depth,
        error_score: declared.error_score.unwrap_or_default(),
        candidates: declared.candidates,
        aux: declared.aux,
        pixel_loss: declared.pixel_loss,
        loss_terms: declared.loss_terms.unwrap_or_default(),
        noise: declared.noise,
        mask: declared.mask,
        cadence: declared.cadence.unwrap_or_default(),
        least_resolution: declared.least_resolution,
        rates: declared.rates.unwrap_or_default(),
        start: declared.start.unwrap_or_default(),
        detailed_edits: declared.detailed_edits,
        scratch_bytes: copies + PYTHON_BYTES + declared.scratch_bytes,
        copies_points: true,
    };
    needs.check().map_err(|problem| PyValueError::new_err(format!("needs: {problem}")))?;
    Ok(needs)
}
