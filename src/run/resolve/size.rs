//! How large a run is: as the options say, or solved for `--memory`.

use super::{DECODERS, Inputs, TEST_DECODERS};
use crate::backend::BackendKind;
use crate::dataset::Resolution;
use crate::failure::{DEVICE, Failure};
use crate::memory::{
    Bytes, Fit, Ledger, MemoryLimit, PAIRS, RunSize, SizeRequest, fit, grant, min_memory, resident,
};
use crate::number::grouped;
use crate::run::values::Budget;

/// Most rows, where `--budget` is not given: trains on a laptop in well under 2 GiB, and carries a room or
/// an object; large outdoor scenes want more.
pub const DEFAULT_BUDGET: usize = 200_000;
/// Memory for decoded photographs, where nothing else is said `[bytes]`.
const DEFAULT_IMAGE_CACHE: u64 = 1 << 30;
/// (Row, tile) pairs per row of the budget, where memory is not given.
const PAIRS_PER_ROW: usize = 16;
/// Fewer rows are no model of a scene, unless fewer are asked for.
const LEAST_ROWS: usize = 1_000;
/// The solution holds for any number of threads up to this, so that it does not depend on them.
const THREADS: usize = 64;
/// What "give --memory" is rounded up to.
const MIB: u64 = 1 << 20;
/// Divisors of the images' sides that are alternatives.
pub(super) const RESOLUTIONS: [Resolution; 3] =
    [Resolution::Divisor(1), Resolution::Divisor(2), Resolution::Divisor(4)];

/// The size of a run.
pub(in crate::run) struct Size {
    pub(in crate::run) setting: RunSize,
    /// The memory given, and what follows from it.
    solved: Option<(u64, Fit)>,
}

impl Size {
    /// As the options say, which name rows.
    pub(in crate::run) fn as_given(inputs: &Inputs<'_>) -> Result<Self, Failure> {
        let rows = inputs.budget().unwrap_or(DEFAULT_BUDGET);
        let most = most_pairs(inputs, rows)?;
        let per_row = inputs.knobs.pairs_per_row.unwrap_or(PAIRS_PER_ROW);
        let pairs = rows.saturating_mul(per_row).min(most);
        let setting = RunSize {
            rows,
            sh_degree: inputs.degree.highest(),
            tile_cap: inputs.tile_cap().unwrap_or(pairs).max(rows),
            image_cache: inputs.image_cache().unwrap_or(DEFAULT_IMAGE_CACHE),
        };
        Ok(Self { setting, solved: None })
    }

    /// As the options say, or as large as `--memory` allows.
    ///
    /// # Errors
    /// When nothing fits, with what would.
    pub(in crate::run) fn choose(inputs: &Inputs<'_>) -> Result<Self, Failure> {
        if let (Some(cap), Some(pairs)) = (inputs.tile_cap(), inputs.knobs.pairs_per_row) {
            return Err(Failure::input(format!(
                "--tile-cap {cap} and --knob pairs_per_row={pairs} contradict each other; give one of \
                 them, such as --tile-cap {cap} with pairs_per_row=auto"
            )));
        }
        let Some(memory) = inputs.memory() else {
            return Self::as_given(inputs);
        };
        let request = request(inputs, memory)?;
        match fit(&request, |setting| bytes(inputs, setting))? {
            Some(fit) => Ok(Self { setting: fit.setting, solved: Some((memory, fit)) }),
            None => Err(too_little(inputs, &request)?),
        }
    }

    /// Whether memory has made the degree lower than was wanted.
    pub(in crate::run) fn is_lowered(&self, inputs: &Inputs<'_>) -> bool {
        self.setting.sh_degree < inputs.degree.highest()
    }

    /// What there is to say about it, a line each.
    pub(in crate::run) fn lines(&self, inputs: &Inputs<'_>) -> Vec<String> {
        let RunSize { rows, sh_degree, tile_cap, image_cache } = self.setting;
        let said = grouped(rows);
        let Some((memory, fit)) = &self.solved else {
            let default = match inputs.spec.size.budget {
                None => " (default; choose with --budget or --memory)",
                Some(Budget::Auto(_)) => " at most (auto: as many as improve the model)",
                Some(Budget::Rows(_)) => "",
            };
            return vec![format!("budget   {said} rows{default}")];
        };
        let memory = Bytes(*memory);
        let mut lines = vec![match inputs.budget() {
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
            match inputs.all_images() {
                all if image_cache >= all => format!("all held decoded ({})", Bytes(all)),
                all => format!(
                    "{} of {} held decoded, the rest streams",
                    Bytes(image_cache),
                    Bytes(all)
                ),
            }
        ));
        let wanted = inputs.degree.highest();
        if self.is_lowered(inputs) {
            let start = inputs.start().unwrap_or(LEAST_ROWS);
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

impl Inputs<'_> {
    /// Most rows, where a number is given.
    fn budget(&self) -> Option<usize> {
        self.spec.size.budget.and_then(Budget::most)
    }

    fn memory(&self) -> Option<u64> {
        self.spec.size.memory.map(|bytes| bytes.0)
    }

    fn tile_cap(&self) -> Option<usize> {
        self.spec.size.tile_cap.map(|pairs| pairs.0)
    }

    fn image_cache(&self) -> Option<u64> {
        self.spec.size.image_cache.map(|bytes| bytes.0)
    }
}

/// Fails where a run would take more than `--memory`. Where that was solved for, it cannot be.
pub(in crate::run) fn check(inputs: &Inputs<'_>, ledger: &Ledger) -> Result<(), Failure> {
    let needed = inputs.device.limited_bytes(ledger);
    match inputs.memory() {
        Some(memory) if needed > memory => Err(Failure::input(format!(
            "--memory {}: this run takes {}; lower --tile-cap, --image-cache or --threads",
            Bytes(memory),
            Bytes(needed)
        ))),
        _ => Ok(()),
    }
}

/// Fails where the system does not grant this process what a run takes.
pub(in crate::run) fn check_grant(inputs: &Inputs<'_>, ledger: &Ledger) -> Result<(), Failure> {
    let granted = grant(inputs.threads() + DECODERS + TEST_DECODERS);
    let (Some(MemoryLimit { left, by }), Some(now)) = (granted, resident()) else { return Ok(()) };
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
    inputs: &Inputs<'_>,
    memory: u64,
    sh_degree: u8,
) -> Result<Option<usize>, Failure> {
    let request = SizeRequest {
        sh_degree: sh_degree..=sh_degree,
        most_rows: inputs.device.largest_budget(sh_degree),
        ..request(inputs, memory)?
    };
    let fit = fit(&request, |setting| bytes(inputs, setting))?;
    Ok(fit.map(|fit| fit.setting.rows))
}

fn bytes(inputs: &Inputs<'_>, setting: &RunSize) -> Result<u64, Failure> {
    let needs = inputs.needs(setting.rows)?;
    let threads = inputs.threads().max(THREADS);
    Ok(inputs.device.limited_bytes(&inputs.ledger(setting, &needs, threads)))
}

fn request(inputs: &Inputs<'_>, memory: u64) -> Result<SizeRequest, Failure> {
    let degrees = inputs.degree.range.clone();
    let possible = inputs.device.largest_budget(*degrees.end());
    Ok(SizeRequest {
        memory,
        least_rows: LEAST_ROWS,
        enough_rows: inputs.start().unwrap_or(LEAST_ROWS),
        most_rows: inputs.budget().map_or(possible, |budget| budget.min(possible)),
        sh_degree: degrees,
        tile_cap: inputs.tile_cap(),
        pairs: inputs.knobs.pairs_per_row.map_or(PAIRS, |pairs| [pairs; 3]),
        most_pairs: most_pairs(inputs, LEAST_ROWS)?,
        // The host's memory, where the device's is bounded.
        image_cache: match inputs.device.kind() {
            BackendKind::Gpu => Some(inputs.image_cache().unwrap_or(DEFAULT_IMAGE_CACHE)),
            BackendKind::Cpu => inputs.image_cache(),
        },
        all_images: inputs.all_images(),
    })
}

/// Most (row, tile) pairs that the backend can hold at a time.
fn most_pairs(inputs: &Inputs<'_>, rows: usize) -> Result<usize, Failure> {
    Ok(inputs.device.most_pairs(&inputs.needs(rows)?))
}

/// What to say where not even the least model fits: what it would take, and what would help.
fn too_little(inputs: &Inputs<'_>, request: &SizeRequest) -> Result<Failure, Failure> {
    let least_of = |inputs: &Inputs<'_>, request: &SizeRequest| {
        min_memory(request, MIB, |setting| bytes(inputs, setting))
    };
    let rows = LEAST_ROWS.min(request.most_rows);
    let degree = *request.sh_degree.start();
    let given = Bytes(request.memory);
    let Some(least) = least_of(inputs, request)? else {
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
        (inputs.tile_cap().is_some_and(|cap| cap > rows), "--tile-cap"),
        (inputs.image_cache().is_some_and(|cache| cache > 0), "--image-cache"),
        (degree > 0, "--sh-degree"),
    ];
    let free =
        SizeRequest { tile_cap: None, image_cache: None, sh_degree: 0..=degree, ..request.clone() };
    let free_least = least_of(inputs, &free)?.unwrap_or(least);
    if free_least < least {
        let names: Vec<&str> = fixed.iter().filter(|(is, _)| *is).map(|(_, name)| *name).collect();
        message += &format!(", or {}MiB without {}", free_least / MIB, names.join(" and "));
    }
    let smaller = RESOLUTIONS.iter().filter_map(|&resolution| {
        let smaller = inputs.at_resolution(resolution)?;
        let request = super::size::request(&smaller, request.memory).ok()?;
        Some((resolution.number(), least_of(&smaller, &request).ok()??))
    });
    let smaller: Vec<(u32, u64)> = smaller.filter(|&(_, bytes)| bytes < least).collect();
    let fits = smaller.iter().find(|(_, bytes)| *bytes <= request.memory);
    if let Some((divisor, bytes)) = fits.or(smaller.last()) {
        message += &format!(", or {}MiB with images shrunk by -r {divisor}", bytes / MIB);
    }
    Ok(Failure::input(message))
}
