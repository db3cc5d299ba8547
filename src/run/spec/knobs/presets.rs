//! Presets: knobs and options that are set together, named after what they promise. Each preset quotes the measurements
//! by `densify trade` on which it is based.

use std::fmt;

use super::KnobError;

/// Knobs and options that are set together.
#[derive(Debug)]
pub struct Preset {
    /// Name, such as `fast`.
    pub name: &'static str,
    /// What the preset promises, in one line.
    pub promise: &'static str,
    /// Knobs and options by name, each with its value.
    pub levels: &'static [(&'static str, &'static str)],
    /// Measured cost and gain; `None` for the reference.
    pub measured: Option<Measured>,
}

/// Measured cost and gain of a preset against `exact`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measured {
    /// Mean difference of PSNR on held-out views `[dB]`.
    pub psnr: f64,
    /// 95 % interval of this difference `[dB]`.
    pub interval: [f64; 2],
    /// Processor time of training, as a ratio to that of `exact`.
    pub seconds: f64,
    /// Peak memory of the process, as a ratio to that of `exact`.
    pub peak: f64,
    /// Scenes and size of the measured runs.
    pub runs: &'static str,
    /// The command that measured it.
    pub command: &'static str,
}

/// The runs behind the figures of `tiny-memory`.
const STUDY: &str = "two built-in scenes, an object and photographs, 2,000 iterations, 20,000 rows, image_cache=0, 4 seeds";

/// The command of these runs.
const COMMAND: &str = "densify trade scene:spheres scene:room data/chair data/cup --knobs preset:tiny-memory --seeds 4 \
                       -i 2000 -b 20k -- --threads 1 --backend cpu";

/// The runs behind the figures of `balanced` and `fast`; the reference runs have the full 30,000 iterations.
const LONG_STUDY: &str = "two built-in scenes, an object and photographs at half their size, 30,000 iterations in \
                          exact, 5,000 rows, 5 seeds";

/// The command of these runs.
const LONG_COMMAND: &str = "densify trade scene:spheres scene:room data/chair data/cup \
                            --knobs iterations:24000:15000 --seeds 5 -i 30000 -b 5k \
                            -- -r 2 --threads 1 --backend cpu";

/// The preset that others are measured against.
pub const EXACT: &str = "exact";

/// The default preset.
pub const DEFAULT_PRESET: &str = "balanced";

/// All presets.
pub static PRESETS: &[Preset] = &[
    Preset {
        name: EXACT,
        promise: "no accuracy traded for time or memory",
        levels: &[
            ("alpha_min", "1/255"),
            ("transmittance_stop", "1e-4"),
            ("param_storage", "f32"),
            ("moment_storage", "f32"),
        ],
        measured: None,
    },
    // Fewer iterations cost less quality than knobs that save as much time: docs/tradeoffs.md.
    Preset {
        name: "balanced",
        promise: "four fifths of the iterations; the rest make no visible difference",
        levels: &[("iterations", "24000")],
        measured: Some(Measured {
            psnr: -0.01,
            interval: [-0.15, 0.17],
            seconds: 0.79,
            peak: 1.00,
            runs: LONG_STUDY,
            command: LONG_COMMAND,
        }),
    },
    Preset {
        name: "fast",
        promise: "half of the iterations",
        levels: &[("iterations", "15000")],
        measured: Some(Measured {
            psnr: 0.03,
            interval: [-0.15, 0.21],
            seconds: 0.49,
            peak: 1.00,
            runs: LONG_STUDY,
            command: LONG_COMMAND,
        }),
    },
    Preset {
        name: "tiny-memory",
        promise: "little memory, at the cost of time",
        // 478 bytes per row at degree 3 with `diet`; docs/memory.md has the table.
        levels: &[
            ("image_cache", "auto"),
            ("param_storage", "f16"),
            ("moment_storage", "both8"),
            ("pairs_per_row", "1"),
        ],
        measured: Some(Measured {
            psnr: 0.11,
            interval: [-0.01, 0.24],
            seconds: 1.40,
            peak: 0.69,
            runs: STUDY,
            command: COMMAND,
        }),
    },
];

/// The preset of this name.
///
/// # Errors
/// When there is none; names all presets.
pub fn preset(name: &str) -> Result<&'static Preset, KnobError> {
    let preset = PRESETS.iter().find(|preset| preset.name == name);
    preset.ok_or_else(|| KnobError::UnknownPreset { name: name.to_owned() })
}

/// The names of all presets.
pub(super) fn names() -> String {
    PRESETS.iter().map(|preset| preset.name).collect::<Vec<_>>().join(", ")
}

impl fmt::Display for Preset {
    /// `fast: half of the iterations; iterations=15000; +0.03 dB [-0.15, +0.21], …`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let levels: Vec<String> =
            self.levels.iter().map(|(knob, value)| format!("{knob}={value}")).collect();
        write!(f, "{}: {}; {}; ", self.name, self.promise, levels.join(" "))?;
        match self.measured {
            None => f.write_str("the reference for the others"),
            Some(Measured { psnr, interval: [low, high], seconds, peak, runs, .. }) => write!(
                f,
                "{psnr:+.2} dB [{low:+.2}, {high:+.2}], {seconds:.2} of the processor time and {peak:.2} \
                 of the memory of exact ({runs})"
            ),
        }
    }
}
