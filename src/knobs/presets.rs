//! Presets: knobs that go together, named by what they promise. Levels are chosen from what
//! `densify trade` measures, and each says what that was.

use std::fmt;

use super::KnobError;

/// Knobs that go together.
#[derive(Debug)]
pub struct Preset {
    /// Its name.
    pub name: &'static str,
    /// What it promises.
    pub what: &'static str,
    /// Knobs with their values, as the table of knobs spells them.
    pub levels: &'static [(&'static str, &'static str)],
    /// What that costs and buys; `None` for the one that the others are measured against.
    pub measured: Option<Measured>,
}

/// What a preset was measured to cost and buy, against `exact`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measured {
    /// Mean difference of PSNR on views held out `[dB]`.
    pub psnr: f64,
    /// Its 95 % interval.
    pub interval: [f64; 2],
    /// Processor time of training, as a ratio.
    pub seconds: f64,
    /// Peak memory of the process, as a ratio.
    pub peak: f64,
    /// Scenes and size of the runs.
    pub on: &'static str,
    /// What measured it.
    pub command: &'static str,
}

/// The runs behind the figures.
const STUDY: &str =
    "two built-in scenes, an object and photographs, 2,000 iterations, 20,000 rows, 5 seeds";

/// How they were made.
const COMMAND: &str = "densify trade scene:spheres scene:room data/chair data/cup --knobs preset --seeds 5 \
                       --no-factorial -i 2000 -b 20k -- --threads 1 --backend cpu";

/// The preset that others are measured against.
pub const EXACT: &str = "exact";

/// The preset of a run that names none.
pub const DEFAULT_PRESET: &str = "balanced";

/// All presets.
pub static PRESETS: &[Preset] = &[
    Preset {
        name: EXACT,
        what: "no shortcut that a knob can take",
        levels: &[
            ("alpha_min", "1/255"),
            ("transmittance_stop", "1e-4"),
            ("exp_degree", "6"),
            ("ssim_every", "1"),
            ("coarse_until", "0"),
            ("budget_share", "1"),
            ("sparse_adam", "off"),
            ("row_degrees", "off"),
            ("param_storage", "f32"),
            ("moment_storage", "f32"),
        ],
        measured: None,
    },
    // As `exact` is: docs/tradeoffs.md has no level that is shown to be free and to save time.
    Preset {
        name: "balanced",
        what: "what costs nothing that can be seen",
        levels: &[],
        measured: Some(Measured {
            psnr: 0.0,
            interval: [0.0, 0.0],
            seconds: 1.0,
            peak: 1.0,
            on: "the same bytes as exact",
            command: "densify train --preset exact",
        }),
    },
    Preset {
        name: "fast",
        what: "time before accuracy",
        levels: &[("budget_share", "0.4"), ("coarse_until", "0.4"), ("transmittance_stop", "1e-3")],
        measured: Some(Measured {
            psnr: -1.03,
            interval: [-1.36, -0.70],
            seconds: 0.55,
            peak: 0.86,
            on: "the same scenes and runs as tiny-memory's, 2 seeds",
            command: "densify trade scene:spheres scene:room data/chair data/cup --knobs preset:fast \
                      --seeds 2 --no-factorial -i 2000 -b 20k -- --threads 1 --backend cpu",
        }),
    },
    Preset {
        name: "tiny-memory",
        what: "memory before time",
        // 479 bytes per row at degree 3 with `diet`; docs/memory.md has the table.
        levels: &[
            ("image_cache", "0"),
            ("param_storage", "f16"),
            ("moment_storage", "ratio8"),
            ("pairs_per_row", "1"),
        ],
        measured: Some(Measured {
            psnr: 0.03,
            interval: [-0.07, 0.12],
            seconds: 1.52,
            peak: 0.73,
            on: STUDY,
            command: COMMAND,
        }),
    },
];

/// The preset of this name.
///
/// # Errors
/// When there is none, with those that there are.
pub fn preset(name: &str) -> Result<&'static Preset, KnobError> {
    PRESETS.iter().find(|preset| preset.name == name).ok_or_else(|| {
        let names: Vec<&str> = PRESETS.iter().map(|preset| preset.name).collect();
        KnobError(format!("no preset is called `{name}`; there are {}", names.join(", ")))
    })
}

impl fmt::Display for Preset {
    /// `fast: ssim_every=5; -0.12 dB [-0.20, -0.05], …`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let levels: Vec<String> =
            self.levels.iter().map(|(knob, value)| format!("{knob}={value}")).collect();
        let levels = if levels.is_empty() { "the defaults".to_owned() } else { levels.join(" ") };
        write!(f, "{}: {}; {levels}; ", self.name, self.what)?;
        match self.measured {
            None => f.write_str("what the others are measured against"),
            Some(Measured { psnr, interval: [low, high], seconds, peak, on, .. }) => write!(
                f,
                "{psnr:+.2} dB [{low:+.2}, {high:+.2}], {seconds:.2} of the processor time and {peak:.2} \
                 of the memory of exact ({on})"
            ),
        }
    }
}
