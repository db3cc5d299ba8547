//! How large a run is: as the options say, or solved for `--memory`.

use std::str::FromStr;

use super::demand::Survey;
use super::setup::{DECODERS, TEST_DECODERS};
use super::{DEFAULT_BUDGET, TrainArgs};
use crate::backend::gpu::GpuBackend;
use crate::cli::failure::{DEVICE, Failure};
use crate::cli::number::{self, grouped};
use crate::cli::scene::DEFAULT_IMAGE_CACHE;
use crate::memory::{
    Bytes, Fit, Grant, Ledger, PAIRS, Setting, Wishes, fit, grant, least_memory, resident,
};

/// (Row, tile) pairs per row of the budget, where memory is not given.
const PAIRS_PER_ROW: usize = 16;
/// Fewer rows are no model of a scene, unless fewer are asked for.
const LEAST_ROWS: usize = 1_000;
/// The solution holds for any number of threads up to this, so that it does not depend on them.
const THREADS: usize = 64;
/// What "give --memory" is rounded up to.
const MIB: u64 = 1 << 20;
/// Divisors of the images' sides that are alternatives.
pub(super) const RESOLUTIONS: [u32; 3] = [1, 2, 4];

/// What is given with `--budget`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Budget {
    /// At most so many rows.
    Rows(usize),
    /// As many as pay.
    Auto,
}

impl FromStr for Budget {
    type Err = String;

    fn from_str(word: &str) -> Result<Self, String> {
        match word {
            "auto" => Ok(Self::Auto),
            _ => number::rows(word).map(Self::Rows).map_err(|error| format!("{error}, or auto")),
        }
    }
}

impl TrainArgs {
    /// Most rows, where a number is given.
    fn rows(&self) -> Option<usize> {
        match self.budget {
            Some(Budget::Rows(rows)) => Some(rows),
            Some(Budget::Auto) | None => None,
        }
    }
}

/// The size of a run.
pub(super) struct Size {
    pub(super) setting: Setting,
    /// The memory given, and what follows from it.
    pub(super) solved: Option<(u64, Fit)>,
}

impl Size {
    /// As the options say, which name rows.
    pub(super) fn as_given(args: &TrainArgs, survey: &Survey) -> Result<Self, Failure> {
        let rows = args.rows().unwrap_or(survey.most_rows.unwrap_or(DEFAULT_BUDGET));
        let most = most_pairs(args, survey, rows)?;
        let per_row = survey.settings.pairs_per_row().unwrap_or(PAIRS_PER_ROW);
        let pairs = rows.saturating_mul(per_row).min(most);
        let setting = Setting {
            rows,
            sh_degree: survey.degree.highest(),
            tile_cap: args.tile_cap.unwrap_or(pairs).max(rows),
            image_cache: args.data.image_cache.unwrap_or(DEFAULT_IMAGE_CACHE),
        };
        Ok(Self { setting, solved: None })
    }

    /// As the options say, or as large as `--memory` allows.
    ///
    /// # Errors
    /// When nothing fits, with what would.
    pub(super) fn choose(args: &TrainArgs, survey: &Survey) -> Result<Self, Failure> {
        // A run that goes on has the cap that was solved for.
        if let (Some(cap), Some(pairs), false) =
            (args.tile_cap, survey.settings.pairs_per_row(), args.resume)
        {
            return Err(Failure::input(format!(
                "--tile-cap {cap} and --knob pairs_per_row={pairs} contradict each other; give one of \
                 them, such as --tile-cap {cap} with pairs_per_row=auto"
            )));
        }
        let Some(memory) = args.memory else {
            return Self::as_given(args, survey);
        };
        let wishes = wishes(args, survey, memory)?;
        match fit(&wishes, |setting| bytes(args, survey, setting))? {
            Some(fit) => Ok(Self { setting: fit.setting, solved: Some((memory, fit)) }),
            None => Err(too_little(args, survey, &wishes)?),
        }
    }

    /// Whether memory has made the degree lower than was wanted.
    pub(super) fn is_lowered(&self, survey: &Survey) -> bool {
        self.setting.sh_degree < survey.degree.highest()
    }

    /// What there is to say about it, a line each.
    pub(super) fn lines(&self, args: &TrainArgs, survey: &Survey) -> Vec<String> {
        let Setting { rows, sh_degree, tile_cap, image_cache } = self.setting;
        let said = grouped(rows);
        let Some((memory, fit)) = &self.solved else {
            let default = match args.budget {
                None => " (default; choose with --budget or --memory)",
                Some(Budget::Auto) => " at most (auto: as many as pay)",
                Some(Budget::Rows(_)) => "",
            };
            return vec![format!("budget   {said} rows{default}")];
        };
        let memory = Bytes(*memory);
        let mut lines = vec![match args.rows() {
            Some(budget) if fit.by_memory => format!(
                "budget   {said} rows: --memory {memory} holds fewer than --budget {}",
                grouped(budget)
            ),
            Some(_) => {
                format!("budget   {said} rows: --memory {memory} would hold as many or more")
            }
            None if fit.by_memory => {
                format!("budget   {said} rows, as many as --memory {memory} holds")
            }
            None => format!("budget   {said} rows, as many as the device takes"),
        }];
        lines.push(format!(
            "memory   {memory} given: degree {sh_degree}, {} (Gaussian, tile) pairs, images {}",
            grouped(tile_cap),
            match survey.all_images() {
                all if image_cache >= all => format!("all held decoded ({})", Bytes(all)),
                all => format!(
                    "{} of {} held decoded, the rest streams",
                    Bytes(image_cache),
                    Bytes(all)
                ),
            }
        ));
        let wanted = survey.degree.highest();
        if self.is_lowered(survey) {
            let start = survey.start(args).unwrap_or(LEAST_ROWS);
            lines.push(format!(
                "note: degree {sh_degree} instead of {wanted}, at which only {} rows fit and the scene \
                 starts with {}; --sh-degree {wanted} insists",
                grouped(fit.at_wanted_degree),
                grouped(start)
            ));
        }
        lines
    }
}

/// Fails where a run would take more than `--memory`. Where that was solved for, it cannot be.
pub(super) fn check(args: &TrainArgs, survey: &Survey, ledger: &Ledger) -> Result<(), Failure> {
    let needed = survey.bounded(ledger);
    match args.memory {
        Some(memory) if needed > memory => Err(Failure::input(format!(
            "--memory {}: this run takes {}; lower --tile-cap, --image-cache or --threads",
            Bytes(memory),
            Bytes(needed)
        ))),
        _ => Ok(()),
    }
}

/// Fails where the system does not grant this process what a run takes.
pub(super) fn check_grant(args: &TrainArgs, ledger: &Ledger) -> Result<(), Failure> {
    let granted = grant(threads(args) + DECODERS + TEST_DECODERS);
    let (Some(Grant { left, by }), Some(now)) = (granted, resident()) else { return Ok(()) };
    let more = ledger.on_host().saturating_sub(now);
    if more <= left {
        return Ok(());
    }
    Err(Failure {
        code: DEVICE,
        message: format!(
            "this run takes {} of the host's memory, of which the process has {}; {by} leaves it {}; \
             give --memory {}MiB, or lower --budget",
            Bytes(ledger.on_host()),
            Bytes(now),
            Bytes(left),
            (now + left) / MIB
        ),
    })
}

/// The rows that fit in `memory` at a degree, where nothing else limits them.
pub(super) fn rows_at(
    args: &TrainArgs,
    survey: &Survey,
    memory: u64,
    sh_degree: u8,
) -> Result<Option<usize>, Failure> {
    let wishes = Wishes {
        sh_degree: sh_degree..=sh_degree,
        most_rows: most_rows(survey, sh_degree),
        ..wishes(args, survey, memory)?
    };
    let fit = fit(&wishes, |setting| bytes(args, survey, setting))?;
    Ok(fit.map(|fit| fit.setting.rows))
}

fn bytes(args: &TrainArgs, survey: &Survey, setting: &Setting) -> Result<u64, Failure> {
    let needs = survey.needs(args, setting.rows)?;
    let threads = threads(args).max(THREADS);
    Ok(survey.bounded(&survey.ledger(args, setting, &needs, threads)))
}

/// Threads that train and measure.
pub(super) fn threads(args: &TrainArgs) -> usize {
    args.threads.map_or_else(rayon::current_num_threads, usize::from)
}

fn wishes(args: &TrainArgs, survey: &Survey, memory: u64) -> Result<Wishes, Failure> {
    let degrees = survey.degree.range.clone();
    let possible = most_rows(survey, *degrees.end());
    Ok(Wishes {
        memory,
        least_rows: LEAST_ROWS,
        enough_rows: survey.start(args).unwrap_or(LEAST_ROWS),
        most_rows: args.rows().map_or(possible, |budget| budget.min(possible)),
        sh_degree: degrees,
        tile_cap: args.tile_cap,
        pairs: survey.settings.pairs_per_row().map_or(PAIRS, |pairs| [pairs; 3]),
        most_pairs: most_pairs(args, survey, LEAST_ROWS)?,
        // The host's memory, where the device's is bounded.
        image_cache: match &survey.device {
            Some(_) => Some(args.data.image_cache.unwrap_or(DEFAULT_IMAGE_CACHE)),
            None => args.data.image_cache,
        },
        all_images: survey.all_images(),
    })
}

/// Most rows that the backend can hold.
fn most_rows(survey: &Survey, sh_degree: u8) -> usize {
    let most = survey.device.as_ref().map(|device| device.adapter().largest_budget(sh_degree));
    most.map_or(u32::MAX as usize, |most| most as usize)
}

/// Most (row, tile) pairs that the backend can hold at a time.
fn most_pairs(args: &TrainArgs, survey: &Survey, rows: usize) -> Result<usize, Failure> {
    let Some(device) = &survey.device else { return Ok(u32::MAX as usize) };
    Ok(GpuBackend::most_pairs(&survey.needs(args, rows)?, device) as usize)
}

/// What to say where not even the least model fits: what it would take, and what would help.
fn too_little(args: &TrainArgs, survey: &Survey, wishes: &Wishes) -> Result<Failure, Failure> {
    let least_of = |survey: &Survey, wishes: &Wishes| {
        least_memory(wishes, MIB, |setting| bytes(args, survey, setting))
    };
    let rows = LEAST_ROWS.min(wishes.most_rows);
    let degree = *wishes.sh_degree.start();
    let given = Bytes(wishes.memory);
    let Some(least) = least_of(survey, wishes)? else {
        return Ok(Failure::input(format!("--memory {given}: no size of a run can be computed")));
    };
    let mut message = format!(
        "--memory {given} holds no model of this scene: {} rows at degree {degree} take {} MiB; give \
         --memory {}MiB",
        grouped(rows),
        least / MIB,
        least / MIB
    );
    // Options that were given and take more than they must.
    let fixed = [
        (args.tile_cap.is_some_and(|cap| cap > rows), "--tile-cap"),
        (args.data.image_cache.is_some_and(|cache| cache > 0), "--image-cache"),
        (degree > 0, "--sh-degree"),
    ];
    let free =
        Wishes { tile_cap: None, image_cache: None, sh_degree: 0..=degree, ..wishes.clone() };
    let free_least = least_of(survey, &free)?.unwrap_or(least);
    if free_least < least {
        let names: Vec<&str> = fixed.iter().filter(|(is, _)| *is).map(|(_, name)| *name).collect();
        message += &format!(", or {}MiB without {}", free_least / MIB, names.join(" and "));
    }
    let smaller = RESOLUTIONS.iter().filter_map(|&divisor| {
        let smaller = survey.at_resolution(args, divisor)?;
        let wishes = super::size::wishes(args, &smaller, wishes.memory).ok()?;
        Some((divisor, least_of(&smaller, &wishes).ok()??))
    });
    let smaller: Vec<(u32, u64)> = smaller.filter(|&(_, bytes)| bytes < least).collect();
    let fits = smaller.iter().find(|(_, bytes)| *bytes <= wishes.memory);
    if let Some((divisor, bytes)) = fits.or(smaller.last()) {
        message += &format!(", or {}MiB with images shrunk by -r {divisor}", bytes / MIB);
    }
    Ok(Failure::input(message))
}
