//! A policy's learning rates and intervals of optimiser steps.

use serde::{Deserialize, Serialize};

use super::above_zero;

/// The interval of optimiser steps; in between, gradients are summed over the views.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Cadence {
    /// Iterations per optimiser step, for all parameters; >= 1.
    pub all: u32,
    /// Iterations per optimiser step of the spherical-harmonic coefficients of bands 1–3, >= 1; the larger of
    /// `all` and `sh_rest` applies to them.
    pub sh_rest: u32,
}

impl Default for Cadence {
    fn default() -> Self {
        Self { all: 1, sh_rest: 1 }
    }
}

impl Cadence {
    /// True if an optimiser step follows iteration `step`: first for all parameters but the
    /// spherical-harmonic coefficients of bands 1–3, then for these coefficients.
    pub fn steps_at(self, step: u32) -> [bool; 2] {
        let all = self.all.max(1);
        [step.is_multiple_of(all), step.is_multiple_of(self.sh_rest.max(all))]
    }

    /// True if a backend made for `longest` has the gradient sums and step counts that this cadence needs.
    pub fn is_within(self, longest: Self) -> bool {
        let is_valid = self.all > 0 && self.sh_rest > 0;
        let all_fits = self.all == 1 || longest.all > 1;
        let sh_rest_fits = self.sh_rest <= self.all || longest.sh_rest > 1;
        is_valid && all_fits && sh_rest_fits
    }
}

/// Learning rates published with a policy; `None`: the trainer's rate applies.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct RateOverrides {
    /// Means `[fraction of the extent per step]`.
    pub mean: Option<Rate>,
    /// Log-scales.
    pub log_scale: Option<Rate>,
    /// Quaternions.
    pub quat: Option<Rate>,
    /// Opacity logits.
    pub opacity: Option<Rate>,
    /// Spherical-harmonic coefficients of band 0.
    pub sh_dc: Option<Rate>,
    /// Spherical-harmonic coefficients of bands 1–3.
    pub sh_rest: Option<Rate>,
    /// A late fade of the rates of opacities and of all spherical-harmonic coefficients.
    pub fade: Option<Fade>,
}

/// A learning rate, which falls (or rises) log-linearly over the run.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Rate {
    /// The rate at the start of the run, > 0.
    pub start: f64,
    /// The rate at the end of the run, > 0.
    pub end: f64,
}

/// A factor on learning rates that falls log-linearly from 1 to `to` between `from` and the end of a run, so
/// that the model does not memorise single photographs.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Fade {
    /// Share of the run after which the fade begins, in `[0, 1)`.
    pub from: f64,
    /// The factor at the end of the run, in (0, 1].
    pub to: f64,
}

impl Rate {
    /// A rate that does not change during the run.
    pub const fn constant(rate: f64) -> Self {
        Self { start: rate, end: rate }
    }
}

impl RateOverrides {
    pub(super) fn check(&self) -> Result<(), String> {
        for (name, rate) in [
            ("mean", self.mean),
            ("log_scale", self.log_scale),
            ("quat", self.quat),
            ("opacity", self.opacity),
            ("sh_dc", self.sh_dc),
            ("sh_rest", self.sh_rest),
        ] {
            let Some(rate) = rate else { continue };
            above_zero(&format!("rates.{name}.start"), rate.start)?;
            above_zero(&format!("rates.{name}.end"), rate.end)?;
        }
        match self.fade {
            Some(Fade { from, .. }) if !(0.0..1.0).contains(&from) => {
                Err(format!("rates.fade.from is {from}; it must be at least 0 and below 1"))
            }
            Some(Fade { to, .. }) if !(to > 0.0 && to <= 1.0) => {
                Err(format!("rates.fade.to is {to}; it must be above 0 and at most 1"))
            }
            _ => Ok(()),
        }
    }
}
