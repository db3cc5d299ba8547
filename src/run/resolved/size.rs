//! The size of a run: taken from the options, or solved for `--memory`.

use super::ResolvedRun;
use super::case::{Case, DECODERS, TEST_DECODERS};
use super::fit::{
    Fit, IMAGE_SHARE_DIVISOR, PAIRS, RunSize, SizeRequest, fit, largest_where, min_memory,
};
use super::remedy::remedies;
use crate::failure::{DEVICE, Failure, Remedy, SizeProblem, notes};
use crate::process::{MemoryLimit, ProcessMemory};
use crate::spec::{Budget, ByteCount, ImageCache};
use densify_core::budget::RowBudget;
use densify_core::memory::{Bytes, Ledger};
use densify_core::numbers::grouped;
use densify_core::spelling::Spelling;
use densify_data::dataset::Resolution;
use densify_render::{BackendKind, TILE};

/// Default of `--budget`: a model of this size trains on a laptop in well under 2 GiB, and is enough for a room or an
/// object; large outdoor scenes need more.
pub const DEFAULT_BUDGET: usize = 200_000;
/// Memory for decoded photographs without `--image-cache` `[bytes]`.
const DEFAULT_IMAGE_CACHE: u64 = 1 << 30;
/// (Row, tile) pairs per row of the budget without `--memory`.
const PAIRS_PER_ROW: usize = 16;
/// On a GPU, lists with more than [`PAIRS`]`[0]` pairs per row have at most this many pairs per tile of the largest image,
/// or [`PAIRS_OF_SMALL_IMAGE`]. Few views exceed that, and those are rendered in bands.
const PAIRS_PER_TILE: usize = 512;
const PAIRS_OF_SMALL_IMAGE: usize = 1 << 20;
/// Minimum number of trained rows of a useful model, unless the user asks for fewer.
pub(super) const MIN_ROWS: usize = 1_000;
/// Memory in messages is rounded up to a multiple of this `[bytes]`.
pub(super) const MIB: u64 = 1 << 20;
/// Image sizes that `densify plan` shows as alternatives.
pub(super) const RESOLUTIONS: [Resolution; 3] =
    [Resolution::Divisor(1), Resolution::Divisor(2), Resolution::Divisor(4)];

/// The size of a run.
pub(super) struct Size {
    pub(super) run_size: RunSize,
    /// The memory limit and the solution for it, if there is a limit.
    solved: Option<(u64, Fit)>,
}

impl Size {
    /// Takes the size from the options.
    pub(super) fn as_given(case: &Case<'_>) -> Result<Self, Failure> {
        let rows = case.asked_budget().unwrap_or(DEFAULT_BUDGET);
        let max_pairs = max_pairs(case, rows)?;
        let pairs = match case.choices.knobs.pairs_per_row {
            Some(per_row) => rows.saturating_mul(per_row),
            None => case.default_pairs(rows),
        };
        let pairs = pairs.min(max_pairs);
        let mut run_size = RunSize {
            rows,
            sh_degree: case.choices.degree.highest(),
            tile_cap: case.tile_cap().unwrap_or(pairs).max(rows),
            image_cache: 0,
            images_on_gpu: 0,
        };
        run_size.image_cache = match case.spec.size.image_cache {
            None => DEFAULT_IMAGE_CACHE,
            Some(ImageCache::Bytes(bytes)) => bytes,
            // An eighth of the total, that is, a seventh of the rest.
            Some(ImageCache::Auto) => {
                let rest = case.ledger_of(&run_size)?.on_host();
                (rest / (IMAGE_SHARE_DIVISOR - 1))
                    .min(DEFAULT_IMAGE_CACHE)
                    .min(case.all_image_bytes())
            }
        };
        let share = case.memory().map_or(u64::MAX, |memory| memory / IMAGE_SHARE_DIVISOR);
        run_size.images_on_gpu = case.image_cache().unwrap_or(DEFAULT_IMAGE_CACHE).min(share);
        Ok(Self { run_size, solved: None })
    }

    /// Takes the size from the options, or the largest that `--memory` allows.
    ///
    /// # Errors
    /// When no size fits; the error lists changes of the options after which one does.
    pub(super) fn choose(case: &Case<'_>) -> Result<Self, Failure> {
        let Some(size) = solve(case)? else {
            return Err(no_size_error(case, &request(case, case.memory().unwrap_or(0))?)?);
        };
        let budget = case.budget(size.run_size.rows);
        if budget.trainable() == 0 {
            let RowBudget { total, frozen } = budget;
            return Err(SizeProblem::FreezeFillsBudget { frozen, budget: total }.into());
        }
        Ok(size)
    }

    /// True if memory made the degree lower than requested.
    pub(super) fn is_lowered(&self, case: &Case<'_>) -> bool {
        self.run_size.sh_degree < case.choices.degree.highest()
    }

    /// Lines for the user about the size and the reason for it.
    pub(super) fn lines(&self, case: &Case<'_>, spelling: Spelling) -> Vec<String> {
        let RunSize { rows, sh_degree, tile_cap, image_cache, .. } = self.run_size;
        let solved = self.solved.as_ref();
        let limit = solved.map(|(memory, fit)| (*memory, fit.by_memory));
        let given = case.spec.size.budget;
        let is_auto = matches!(given, Some(Budget::Auto(_)));
        let most = given.and_then(Budget::most);
        let mut lines = vec![notes::budget(spelling, rows, is_auto, most, limit)];
        let Some((memory, fit)) = solved else { return lines };
        let memory = Bytes(*memory);
        lines.push(format!(
            "memory   {memory} given: degree {sh_degree}, {} (Gaussian, tile) pairs, images {}",
            grouped(tile_cap),
            match case.all_image_bytes() {
                all if image_cache >= all => format!("all kept decoded ({})", Bytes(all)),
                all => format!(
                    "{} of {} kept decoded, the rest decoded when needed",
                    Bytes(image_cache),
                    Bytes(all)
                ),
            }
        ));
        let wanted = case.choices.degree.highest();
        if self.is_lowered(case) {
            let start = case.wanted_initial_rows().unwrap_or(MIN_ROWS);
            let degrees = [sh_degree, wanted];
            lines.push(notes::degree_lowered(spelling, degrees, fit.at_wanted_degree, start));
        }
        lines
    }
}

impl Case<'_> {
    /// The ledger and the unused part of `--memory`, for the user.
    pub(crate) fn memory_table(&self, ledger: &Ledger, spelling: Spelling) -> String {
        let left = self
            .memory()
            .map(|memory| memory.saturating_sub(self.inputs.device.limited_bytes(ledger)));
        let left = left.map_or_else(String::new, |left| notes::memory_left(spelling, left));
        format!("memory promised\n{ledger}{left}")
    }

    /// Minimum number of rows of a useful model, including frozen ones, unless the user asks for fewer.
    fn min_rows(&self) -> usize {
        self.rows_for(MIN_ROWS)
    }

    /// Maximum number of (row, tile) pairs of this many rows without options about it.
    fn default_pairs(&self, rows: usize) -> usize {
        let enough = self.enough_pairs().max(rows.saturating_mul(PAIRS[0]));
        rows.saturating_mul(PAIRS_PER_ROW).min(enough)
    }

    /// Number of (row, tile) pairs that few views exceed.
    fn enough_pairs(&self) -> usize {
        match self.inputs.device.kind() {
            BackendKind::Cpu => usize::MAX,
            BackendKind::Gpu => pairs_of_image(self.inputs.dataset.largest_image()),
        }
    }

    /// The limit that the user set on the number of rows, if any.
    fn asked_budget(&self) -> Option<usize> {
        self.spec.size.budget.and_then(Budget::most)
    }

    pub(super) fn memory(&self) -> Option<u64> {
        self.spec.size.memory.map(|bytes| bytes.0)
    }

    fn tile_cap(&self) -> Option<usize> {
        self.spec.size.tile_cap.map(|pairs| pairs.0)
    }

    /// Bytes for decoded photographs, if the user gave a number.
    fn image_cache(&self) -> Option<u64> {
        match self.spec.size.image_cache? {
            ImageCache::Bytes(bytes) => Some(bytes),
            ImageCache::Auto => None,
        }
    }
}

impl ResolvedRun<'_> {
    /// Fails if the run would take more than `--memory`. A size solved for `--memory` always fits, but a resumed run
    /// may be given another `--tile-cap` or `--image-cache`.
    pub(crate) fn check_memory(&self, ledger: &Ledger) -> Result<(), Failure> {
        let Self { case, size, .. } = self;
        let needed = case.inputs.device.limited_bytes(ledger);
        let Some(memory) = case.memory().filter(|memory| needed > *memory) else { return Ok(()) };
        let fits = |pairs: usize| {
            let size = RunSize { tile_cap: pairs, ..*size };
            Ok::<_, Failure>(bytes(case, &size)? <= memory)
        };
        let pairs = largest_where(size.rows, size.tile_cap, fits)?.unwrap_or(size.rows);
        let changes = [Remedy::NoImages, Remedy::TileCap(pairs)];
        let remedies = remedies(case, case.spec, &changes, |case| {
            Ok(bytes(case, &Size::as_given(case)?.run_size)? <= memory)
        });
        Err(SizeProblem::OverMemory { memory, needed, remedies }.into())
    }

    /// Fails if the system does not grant this process the memory of the run.
    pub(crate) fn check_grant(
        &self,
        process: ProcessMemory,
        is_resumed: bool,
    ) -> Result<(), Failure> {
        let Self { case, size, .. } = self;
        let ledger = case.ledger_of(size)?;
        let granted = (process.grant)(case.choices.threads + DECODERS + TEST_DECODERS);
        let (Some(MemoryLimit { left, name }), Some(now)) = (granted, (process.resident)()) else {
            return Ok(());
        };
        let more = ledger.on_host().saturating_sub(now);
        if more <= left {
            return Ok(());
        }
        // Leave a 64th unused: the memory that the system grants varies from call to call.
        let allowed = (now + left) / 64 * 63;
        let on_host = |case: &Case<'_>| {
            let Some(Size { run_size, .. }) = solve(case)? else { return Ok(false) };
            Ok::<_, Failure>(case.ledger_of(&run_size)?.on_host() <= allowed)
        };
        let mut base = case.spec.clone();
        // `--memory` is no remedy on a GPU: there it limits the device's memory.
        let lower_limit =
            (!is_resumed && case.inputs.device.kind() == BackendKind::Cpu).then(|| {
                base.size.memory = Some(ByteCount(allowed / MIB * MIB));
                Remedy::Memory(allowed / MIB)
            });
        let mut fixes = if is_resumed {
            Vec::new()
        } else if lower_limit.is_some()
            && case.with(&base).and_then(|case| on_host(&case)).unwrap_or(false)
        {
            vec![Vec::new()]
        } else {
            remedies(case, &base, &Remedy::NEW_RUN, on_host)
        };
        fixes.iter_mut().for_each(|changes| changes.splice(0..0, lower_limit).for_each(drop));
        let needed = ledger.on_host();
        let problem =
            SizeProblem::OverGrant { needed, resident: now, limit: name, left, remedies: fixes };
        Err(Failure::with_code(DEVICE, problem))
    }
}

/// The size of a run according to its options, or the largest that `--memory` allows; `None` if nothing fits.
///
/// # Errors
/// When options contradict each other.
pub(super) fn solve(case: &Case<'_>) -> Result<Option<Size>, Failure> {
    if let (Some(cap), Some(pairs)) = (case.tile_cap(), case.choices.knobs.pairs_per_row) {
        return Err(SizeProblem::TileCapConflict { cap, pairs }.into());
    }
    let Some(memory) = case.memory() else {
        return Size::as_given(case).map(Some);
    };
    let fit = fit(&request(case, memory)?, |size| bytes(case, size))?;
    Ok(fit.map(|fit| Size { run_size: fit.size, solved: Some((memory, fit)) }))
}

/// The number of rows that fit in `memory` at this degree, ignoring the budget; `None` if it is below both [`MIN_ROWS`]
/// and `planned`.
pub(super) fn rows_at(
    case: &Case<'_>,
    memory: u64,
    sh_degree: u8,
    planned: usize,
) -> Result<Option<usize>, Failure> {
    let request = SizeRequest {
        sh_degree: sh_degree..=sh_degree,
        min_rows: case.min_rows().min(planned),
        max_rows: case.inputs.device.largest_budget(sh_degree),
        ..request(case, memory)?
    };
    let fit = fit(&request, |size| bytes(case, size))?;
    Ok(fit.map(|fit| fit.size.rows))
}

/// The fewest bytes for a run of these rows and this degree: with the shortest tile lists, and without a cache of
/// decoded images unless its size is given. Any further bytes of the run only make it faster.
pub(super) fn needed_bytes(case: &Case<'_>, size: &RunSize) -> Result<u64, Failure> {
    let request = request(case, u64::MAX)?;
    let request = SizeRequest { image_cache: Some(case.image_cache().unwrap_or(0)), ..request };
    bytes(case, &request.size(size.rows, size.sh_degree, request.pairs[0]))
}

/// Bytes of a run of this size that count towards `--memory`.
fn bytes(case: &Case<'_>, size: &RunSize) -> Result<u64, Failure> {
    Ok(case.inputs.device.limited_bytes(&case.ledger_of(size)?))
}

fn request(case: &Case<'_>, memory: u64) -> Result<SizeRequest, Failure> {
    let degrees = case.choices.degree.range.clone();
    let possible = case.inputs.device.largest_budget(*degrees.end());
    Ok(SizeRequest {
        memory,
        min_rows: case.min_rows(),
        enough_rows: case.rows_for(case.wanted_initial_rows().unwrap_or(MIN_ROWS)),
        max_rows: case.asked_budget().map_or(possible, |budget| budget.min(possible)),
        sh_degree: degrees,
        tile_cap: case.tile_cap(),
        pairs: case.choices.knobs.pairs_per_row.map_or(PAIRS, |pairs| [pairs; 3]),
        max_pairs: max_pairs(case, case.min_rows())?,
        enough_pairs: match case.choices.knobs.pairs_per_row {
            Some(_) => usize::MAX,
            None => case.enough_pairs(),
        },
        // On a GPU the image cache is in host memory, which `--memory` does not limit.
        image_cache: match case.inputs.device.kind() {
            BackendKind::Gpu => Some(case.image_cache().unwrap_or(DEFAULT_IMAGE_CACHE)),
            BackendKind::Cpu => case.image_cache(),
        },
        max_image_bytes: DEFAULT_IMAGE_CACHE,
        all_image_bytes: case.all_image_bytes(),
    })
}

/// Number of (row, tile) pairs that few views of this size `[px]` exceed.
fn pairs_of_image((width, height): (u32, u32)) -> usize {
    let tiles = width.div_ceil(TILE) as usize * height.div_ceil(TILE) as usize;
    tiles.saturating_mul(PAIRS_PER_TILE).max(PAIRS_OF_SMALL_IMAGE)
}

/// Maximum number of (row, tile) pairs that the backend supports at a time.
fn max_pairs(case: &Case<'_>, rows: usize) -> Result<usize, Failure> {
    Ok(case.inputs.device.most_pairs(&case.needs(rows)?, case.has_depth()))
}

/// The error if not even the smallest model fits: the memory that it takes, and verified changes of options with which
/// a model fits.
fn no_size_error(case: &Case<'_>, request: &SizeRequest) -> Result<Failure, Failure> {
    let rows = case.min_rows().min(request.max_rows);
    let degree = *request.sh_degree.start();
    let memory = request.memory;
    let Some(needed) = min_memory(request, MIB, |size| bytes(case, size))? else {
        return Ok(SizeProblem::NoSize { memory }.into());
    };
    let mut fixes = remedies(case, case.spec, &Remedy::NEW_RUN, |case| Ok(solve(case)?.is_some()));
    let fewer = SizeRequest { min_rows: case.rows_for(1), ..request.clone() };
    if let Some(fewer) = fit(&fewer, |size| bytes(case, size))? {
        fixes.push(vec![Remedy::Budget(fewer.size.rows)]);
    }
    let needed = needed / MIB;
    fixes.push(vec![Remedy::Memory(needed)]);
    Ok(SizeProblem::NoModelFits { memory, rows, sh_degree: degree, needed, remedies: fixes }.into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lists_grow_with_the_image_but_not_below_those_of_a_small_one() {
        assert_eq!(pairs_of_image((1600, 1000)), 100 * 63 * 512);
        assert_eq!(pairs_of_image((17, 16)), PAIRS_OF_SMALL_IMAGE);
    }
}
