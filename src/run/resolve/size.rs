//! How large a run is: as the options say, or solved for `--memory`.

use super::remedy::{Change, any_of, remedies};
use super::{DECODERS, Inputs, TEST_DECODERS};
use crate::failure::{DEVICE, Failure};
use crate::memory::{
    Fit, IMAGES, MemoryLimit, PAIRS, RunSize, SizeRequest, fit, grant, min_memory, most_within,
};
use crate::values::{Budget, ByteCount, ImageCache};
use densify_core::memory::{Bytes, Ledger, resident};
use densify_core::numbers::grouped;
use densify_data::dataset::Resolution;
use densify_render::BackendKind;

/// Most rows, where `--budget` is not given: trains on a laptop in well under 2 GiB, and carries a room or
/// an object; large outdoor scenes want more.
pub const DEFAULT_BUDGET: usize = 200_000;
/// Memory for decoded photographs, where nothing else is said `[bytes]`.
const DEFAULT_IMAGE_CACHE: u64 = 1 << 30;
/// (Row, tile) pairs per row of the budget, where memory is not given.
const PAIRS_PER_ROW: usize = 16;
/// Fewer rows that are trained are no model of a scene, unless fewer are asked for.
pub(super) const LEAST_ROWS: usize = 1_000;
/// What "give --memory" is rounded up to.
pub(super) const MIB: u64 = 1 << 20;
/// Divisors of the images' sides that are alternatives.
pub(super) const RESOLUTIONS: [Resolution; 3] =
    [Resolution::Divisor(1), Resolution::Divisor(2), Resolution::Divisor(4)];

/// The size of a run.
pub(crate) struct Size {
    pub(crate) setting: RunSize,
    /// The memory given, and what follows from it.
    solved: Option<(u64, Fit)>,
}

impl Size {
    /// As the options say, which name rows.
    pub(crate) fn as_given(inputs: &Inputs<'_>) -> Result<Self, Failure> {
        let rows = inputs.budget().unwrap_or(DEFAULT_BUDGET);
        let most = most_pairs(inputs, rows)?;
        let per_row = inputs.knobs.pairs_per_row.unwrap_or(PAIRS_PER_ROW);
        let pairs = rows.saturating_mul(per_row).min(most);
        let mut setting = RunSize {
            rows,
            sh_degree: inputs.degree.highest(),
            tile_cap: inputs.tile_cap().unwrap_or(pairs).max(rows),
            image_cache: 0,
            images_on_gpu: 0,
        };
        setting.image_cache = match inputs.spec.size.image_cache {
            None => DEFAULT_IMAGE_CACHE,
            Some(ImageCache::Bytes(bytes)) => bytes,
            // With the rest these are an eighth.
            Some(ImageCache::Auto) => {
                let rest = inputs.ledger(&setting, &inputs.needs(rows)?).on_host();
                (rest / (IMAGES - 1)).min(DEFAULT_IMAGE_CACHE).min(inputs.all_images())
            }
        };
        let share = inputs.memory().map_or(u64::MAX, |memory| memory / IMAGES);
        setting.images_on_gpu = inputs.image_cache().unwrap_or(DEFAULT_IMAGE_CACHE).min(share);
        Ok(Self { setting, solved: None })
    }

    /// As the options say, or as large as `--memory` allows.
    ///
    /// # Errors
    /// When nothing fits, with what would.
    pub(crate) fn choose(inputs: &Inputs<'_>) -> Result<Self, Failure> {
        match (solve(inputs)?, inputs.memory()) {
            (Some(size), _) if size.setting.rows <= inputs.frozen_rows() => {
                Err(Failure::input(format!(
                    "--freeze: its {} Gaussians leave no room in a budget of {}, which counts them too; give a larger \
                 --budget, or --freeze fewer",
                    grouped(inputs.frozen_rows()),
                    grouped(size.setting.rows)
                )))
            }
            (Some(size), _) => Ok(size),
            (None, memory) => Err(too_little(inputs, &request(inputs, memory.unwrap_or(0))?)?),
        }
    }

    /// Whether memory has made the degree lower than was wanted.
    pub(crate) fn is_lowered(&self, inputs: &Inputs<'_>) -> bool {
        self.setting.sh_degree < inputs.degree.highest()
    }

    /// What there is to say about it, a line each.
    pub(crate) fn lines(&self, inputs: &Inputs<'_>) -> Vec<String> {
        let RunSize { rows, sh_degree, tile_cap, image_cache, .. } = self.setting;
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
    /// The ledger, and what it leaves of `--memory`.
    pub(crate) fn promise(&self, ledger: &Ledger) -> String {
        let left = self.memory().map(|it| it.saturating_sub(self.device.limited_bytes(ledger)));
        let left = left.map_or_else(String::new, |left| {
            format!("\n  {:<11} {} of --memory", "left", Bytes(left))
        });
        format!("memory promised\n{ledger}{left}")
    }

    /// Fewer rows are no model of a scene, unless fewer are asked for.
    fn least_rows(&self) -> usize {
        LEAST_ROWS + self.frozen_rows()
    }

    /// Most rows, where a number is given.
    fn budget(&self) -> Option<usize> {
        self.spec.size.budget.and_then(Budget::most)
    }

    pub(super) fn memory(&self) -> Option<u64> {
        self.spec.size.memory.map(|bytes| bytes.0)
    }

    fn tile_cap(&self) -> Option<usize> {
        self.spec.size.tile_cap.map(|pairs| pairs.0)
    }

    /// Bytes of decoded photographs, where a number is given.
    fn image_cache(&self) -> Option<u64> {
        match self.spec.size.image_cache? {
            ImageCache::Bytes(bytes) => Some(bytes),
            ImageCache::Auto => None,
        }
    }
}

/// Fails where a run would take more than `--memory`. Where that was solved for, it cannot be: of a run
/// that goes on, tile lists and photographs may have been given anew.
pub(crate) fn check(
    inputs: &Inputs<'_>,
    setting: &RunSize,
    ledger: &Ledger,
) -> Result<(), Failure> {
    let needed = inputs.device.limited_bytes(ledger);
    let Some(memory) = inputs.memory().filter(|memory| needed > *memory) else { return Ok(()) };
    let fits = |pairs: usize| {
        let size = RunSize { tile_cap: pairs, ..*setting };
        Ok::<_, Failure>(bytes(inputs, &size)? <= memory)
    };
    let pairs = most_within(setting.rows, setting.tile_cap, fits)?.unwrap_or(setting.rows);
    let changes = [Change::NoImages, Change::TileCap(pairs)];
    let found = remedies(inputs, inputs.spec, &changes, |inputs| {
        Ok(bytes(inputs, &Size::as_given(inputs)?.setting)? <= memory)
    });
    let remedy = match &found[..] {
        [] => "leave out --tile-cap, --image-cache and --threads".to_owned(),
        found => format!("give {}", any_of(found)),
    };
    Err(Failure::input(format!(
        "--memory {}: this run takes {}; {remedy}",
        Bytes(memory),
        Bytes(needed)
    )))
}

/// Fails where the system does not grant this process what a run takes.
pub(crate) fn check_grant(
    inputs: &Inputs<'_>,
    setting: &RunSize,
    is_resumed: bool,
) -> Result<(), Failure> {
    let ledger = inputs.ledger(setting, &inputs.needs(setting.rows)?);
    let granted = grant(inputs.threads() + DECODERS + TEST_DECODERS);
    let (Some(MemoryLimit { left, by }), Some(now)) = (granted, resident()) else { return Ok(()) };
    let more = ledger.on_host().saturating_sub(now);
    if more <= left {
        return Ok(());
    }
    // Not all: what is granted varies from call to call.
    let most = (now + left) / 64 * 63;
    let on_host = |inputs: &Inputs<'_>| {
        let Some(Size { setting, .. }) = solve(inputs)? else { return Ok(false) };
        let ledger = inputs.ledger(&setting, &inputs.needs(setting.rows)?);
        Ok::<_, Failure>(ledger.on_host() <= most)
    };
    let mut base = inputs.spec.clone();
    let mut found = Vec::new();
    if !is_resumed && inputs.device.kind() == BackendKind::Cpu {
        // On a GPU it would limit the device's memory.
        let words = format!("--memory {}MiB", most / MIB);
        base.size.memory = Some(ByteCount(most / MIB * MIB));
        found = match inputs.with(&base).and_then(|inputs| on_host(&inputs)).unwrap_or(false) {
            true => vec![words],
            false => remedies(inputs, &base, &Change::NEW, on_host)
                .into_iter()
                .map(|more| format!("{words} {more}"))
                .collect(),
        };
    } else if !is_resumed {
        found = remedies(inputs, &base, &Change::NEW, on_host);
    }
    let remedy = match &found[..] {
        [] => "free memory, or raise that limit".to_owned(),
        found => format!("give {}, or free memory", any_of(found)),
    };
    Err(Failure {
        code: DEVICE,
        message: format!(
            "this run takes {} of the host's memory, of which the process has {}; {by} leaves it {}; \
             {remedy}",
            Bytes(ledger.on_host()),
            Bytes(now),
            Bytes(left),
        ),
    })
}

/// The size of a run as the options say, or as large as `--memory` allows; `None` where nothing fits.
///
/// # Errors
/// When options contradict each other.
pub(super) fn solve(inputs: &Inputs<'_>) -> Result<Option<Size>, Failure> {
    if let (Some(cap), Some(pairs)) = (inputs.tile_cap(), inputs.knobs.pairs_per_row) {
        return Err(Failure::input(format!(
            "--tile-cap {cap} and --knob pairs_per_row={pairs} contradict each other; give one of \
             them, such as --tile-cap {cap} with pairs_per_row=auto"
        )));
    }
    let Some(memory) = inputs.memory() else {
        return Size::as_given(inputs).map(Some);
    };
    let fit = fit(&request(inputs, memory)?, |setting| bytes(inputs, setting))?;
    Ok(fit.map(|fit| Size { setting: fit.setting, solved: Some((memory, fit)) }))
}

/// The rows that fit in `memory` at a degree, where nothing else limits them; fewer than
/// [`LEAST_ROWS`] only where as few were planned.
pub(super) fn rows_at(
    inputs: &Inputs<'_>,
    memory: u64,
    sh_degree: u8,
    planned: usize,
) -> Result<Option<usize>, Failure> {
    let request = SizeRequest {
        sh_degree: sh_degree..=sh_degree,
        least_rows: inputs.least_rows().min(planned),
        most_rows: inputs.device.largest_budget(sh_degree),
        ..request(inputs, memory)?
    };
    let fit = fit(&request, |setting| bytes(inputs, setting))?;
    Ok(fit.map(|fit| fit.setting.rows))
}

/// Bytes of a size that `--memory` limits.
fn bytes(inputs: &Inputs<'_>, setting: &RunSize) -> Result<u64, Failure> {
    let needs = inputs.needs(setting.rows)?;
    Ok(inputs.device.limited_bytes(&inputs.ledger(setting, &needs)))
}

fn request(inputs: &Inputs<'_>, memory: u64) -> Result<SizeRequest, Failure> {
    let degrees = inputs.degree.range.clone();
    let possible = inputs.device.largest_budget(*degrees.end());
    Ok(SizeRequest {
        memory,
        least_rows: inputs.least_rows(),
        enough_rows: inputs.start().unwrap_or(LEAST_ROWS) + inputs.frozen_rows(),
        most_rows: inputs.budget().map_or(possible, |budget| budget.min(possible)),
        sh_degree: degrees,
        tile_cap: inputs.tile_cap(),
        pairs: inputs.knobs.pairs_per_row.map_or(PAIRS, |pairs| [pairs; 3]),
        most_pairs: most_pairs(inputs, inputs.least_rows())?,
        // The host's memory, where the device's is bounded.
        image_cache: match inputs.device.kind() {
            BackendKind::Gpu => Some(inputs.image_cache().unwrap_or(DEFAULT_IMAGE_CACHE)),
            BackendKind::Cpu => inputs.image_cache(),
        },
        most_images: DEFAULT_IMAGE_CACHE,
        all_images: inputs.all_images(),
    })
}

/// Most (row, tile) pairs that the backend can hold at a time.
fn most_pairs(inputs: &Inputs<'_>, rows: usize) -> Result<usize, Failure> {
    Ok(inputs.device.most_pairs(&inputs.needs(rows)?))
}

/// What to say where not even the least model fits: what it would take, and what fits, each tried.
fn too_little(inputs: &Inputs<'_>, request: &SizeRequest) -> Result<Failure, Failure> {
    let rows = inputs.least_rows().min(request.most_rows);
    let degree = *request.sh_degree.start();
    let given = Bytes(request.memory);
    let Some(least) = min_memory(request, MIB, |setting| bytes(inputs, setting))? else {
        return Ok(Failure::input(format!("--memory {given}: no size of a run can be computed")));
    };
    let mut found = remedies(inputs, inputs.spec, &Change::NEW, |it| Ok(solve(it)?.is_some()));
    let fewer = SizeRequest { least_rows: 1 + inputs.frozen_rows(), ..request.clone() };
    if let Some(fewer) = fit(&fewer, |setting| bytes(inputs, setting))? {
        found.push(format!("--budget {}", fewer.setting.rows));
    }
    found.push(format!("--memory {}MiB", least / MIB));
    Ok(Failure::input(format!(
        "--memory {given} holds no model of this scene: {} rows at degree {degree} take {} MiB; give {}",
        grouped(rows),
        least / MIB,
        any_of(&found)
    )))
}
