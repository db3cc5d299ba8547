//! The knobs that are set by `--knob` alone, as a run has them.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::{How, KNOBS, Knob, KnobError, find, number, parse};
use crate::backend::gpu::Accumulation;
use crate::backend::{MomentStorage, ParameterStorage, Shortcuts, Storage};
use crate::trainer::Savings;

/// All knobs that are set by `--knob` alone, by name, each with its value as the table spells it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Settings(BTreeMap<String, String>);

impl Default for Settings {
    fn default() -> Self {
        let knobs = KNOBS.iter().filter(|knob| knob.how == How::Knob);
        Self(knobs.map(|knob| (knob.name.to_owned(), knob.default.to_owned())).collect())
    }
}

impl Settings {
    /// The defaults, with these `NAME=VALUE`. Knobs that are options or parameters by another name are
    /// left out: these take effect, and are checked, where options and parameters are.
    ///
    /// # Errors
    /// When a knob or its value is none.
    pub fn of(settings: &[String]) -> Result<Self, KnobError> {
        let mut all = Self::default();
        for setting in settings {
            let name = setting.split('=').next().unwrap_or_default().trim();
            if find(name).is_ok_and(|knob| knob.how != How::Knob) {
                continue;
            }
            let (knob, value) = parse(setting)?;
            all.0.insert(knob.name.to_owned(), value);
        }
        Ok(all)
    }

    /// The settings of a run as it had them, where it was of a version that lacked some: by default,
    /// but for sums in slots on a GPU, which had no other.
    #[must_use]
    pub fn completed(&self, gpu: bool) -> Self {
        let mut all = Self::default();
        if gpu {
            all.take_accumulation(Accumulation::Slots);
        }
        all.0.extend(self.0.clone());
        all
    }

    /// Notes how the device that was opened adds up, so that `auto` is no longer open.
    pub fn take_accumulation(&mut self, taken: Accumulation) {
        self.0.insert("accumulation".to_owned(), taken.name().to_owned());
    }

    /// How a GPU is to add up gradients; `None` where that is its own choice.
    #[must_use]
    pub fn accumulation(&self) -> Option<Accumulation> {
        Accumulation::of_name(self.text("accumulation"))
    }

    /// Each knob with its value.
    pub fn iter(&self) -> impl Iterator<Item = (&str, &str)> {
        self.0.iter().map(|(name, value)| (&**name, &**value))
    }

    /// Each knob that is not as it is by default.
    pub fn changed(&self) -> impl Iterator<Item = (&'static Knob, &str)> {
        KNOBS.iter().filter_map(|knob| {
            let value = self.0.get(knob.name)?;
            (!knob.is_default(value)).then_some((knob, &**value))
        })
    }

    /// Fails where a backend lacks a knob that is set.
    ///
    /// # Errors
    /// Names the knob.
    pub fn check_backend(&self, gpu: bool) -> Result<(), KnobError> {
        self.changed().try_for_each(|(knob, value)| knob.check_backend(value, gpu))
    }

    /// What of it is a backend's to know.
    #[must_use]
    pub fn shortcuts(&self) -> Shortcuts {
        let default = Shortcuts::default();
        let number = |name: &str| number(self.text(name)).map(|value| value as f32);
        Shortcuts {
            alpha_min: number("alpha_min").unwrap_or(default.alpha_min),
            transmittance_min: number("transmittance_stop").unwrap_or(default.transmittance_min),
        }
    }

    /// How parameters and moments are stored.
    #[must_use]
    pub fn storage(&self) -> Storage {
        Storage {
            parameters: match self.text("param_storage") {
                "f16" => ParameterStorage::F16,
                _ => ParameterStorage::F32,
            },
            moments: match self.text("moment_storage") {
                "both8" => MomentStorage::Both8,
                _ => MomentStorage::F32,
            },
        }
    }

    /// (Row, tile) pairs held per row of the budget; `None` where that is not set.
    #[must_use]
    pub fn pairs_per_row(&self) -> Option<usize> {
        self.text("pairs_per_row").parse().ok()
    }

    /// What of it is the trainer's to know.
    #[must_use]
    pub fn savings(&self) -> Savings {
        Savings {
            ssim_every: self.text("ssim_every").parse().unwrap_or(1),
            coarse_until: number(self.text("coarse_until")).unwrap_or(0.0),
            budget_share: number(self.text("budget_share")).unwrap_or(1.0),
        }
    }

    /// The value of a knob; empty for one that is not set here.
    fn text(&self, name: &str) -> &str {
        self.0.get(name).map_or("", String::as_str)
    }
}
