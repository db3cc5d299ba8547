//! The guarantees of the solver, for random runs whose bytes grow like those of a backend.

use std::convert::Infallible;

use proptest::prelude::*;

use super::*;

/// Bytes of an imaginary run, which grow like those of real runs.
#[derive(Debug, Clone)]
struct ImaginaryRun {
    fixed: u64,
    per_row: u64,
    per_coefficient: u64,
    per_pair: u64,
    largest_image: u64,
    all_image_bytes: u64,
}

impl ImaginaryRun {
    fn bytes(&self, size: &RunSize) -> u64 {
        let RunSize { rows, sh_degree, tile_cap, image_cache, .. } = *size;
        let coefficients = (u64::from(sh_degree) + 1).pow(2);
        let rows = rows.next_multiple_of(16) as u64;
        let image_bytes = image_cache.max(2 * self.largest_image) + self.largest_image;
        self.fixed
            + rows * (self.per_row + coefficients * self.per_coefficient)
            + tile_cap as u64 * self.per_pair
            + image_bytes.min(self.all_image_bytes)
    }

    fn fit(&self, request: &SizeRequest) -> Option<Fit> {
        let bytes = |size: &RunSize| Ok::<_, Infallible>(self.bytes(size));
        fit(request, bytes).unwrap_or_else(|never| match never {})
    }
}

fn runs() -> impl Strategy<Value = ImaginaryRun> {
    let sizes = (0..50_000_000_u64, 1..500_u64, 1..100_u64, 1..80_u64, 1..1_000_000_u64);
    (sizes, 1..300_u64).prop_map(|(sizes, views)| {
        let (fixed, per_row, per_coefficient, per_pair, largest_image) = sizes;
        let all_image_bytes = views * largest_image;
        ImaginaryRun { fixed, per_row, per_coefficient, per_pair, largest_image, all_image_bytes }
    })
}

fn request(run: &ImaginaryRun, memory: u64) -> SizeRequest {
    SizeRequest {
        memory,
        min_rows: 1_000,
        enough_rows: 20_000,
        max_rows: u32::MAX as usize,
        sh_degree: 0..=3,
        tile_cap: None,
        pairs: PAIRS,
        max_pairs: u32::MAX as usize,
        enough_pairs: usize::MAX,
        image_cache: None,
        max_image_bytes: 1 << 30,
        all_image_bytes: run.all_image_bytes,
    }
}

/// Requests with any memory limit, for runs with and without given sizes.
fn requests() -> impl Strategy<Value = (ImaginaryRun, SizeRequest)> {
    let sizes = (
        0..2_000_000_000_u64,
        prop_oneof![Just(u32::MAX as usize), 1..200_000_usize],
        prop_oneof![Just(None), (1..500_000_usize).prop_map(Some)],
        prop_oneof![Just(None), (0..200_000_000_u64).prop_map(Some)],
        0..=3_u8,
        prop_oneof![Just(PAIRS), Just([1; 3]), Just([4; 3])],
    );
    (runs(), sizes).prop_map(|(run, sizes)| {
        let (memory, max_rows, tile_cap, image_cache, lowest, pairs) = sizes;
        let sh_degree = lowest..=3;
        let base = request(&run, memory);
        let request = SizeRequest { max_rows, tile_cap, image_cache, sh_degree, pairs, ..base };
        (run, request)
    })
}

/// Checks that the size fits, keeps the given values, and cannot be larger.
fn check_fit(run: &ImaginaryRun, request: &SizeRequest) -> Result<(), TestCaseError> {
    let SizeRequest { memory, max_rows, tile_cap, image_cache, pairs, .. } = *request;
    let lowest = *request.sh_degree.start();
    let Some(Fit { size, by_memory, at_wanted_degree }) = run.fit(request) else {
        let least = request.size(1_000.min(max_rows), lowest, pairs[0]);
        prop_assert!(run.bytes(&least) > memory);
        return Ok(());
    };
    prop_assert!(run.bytes(&size) <= memory);
    prop_assert!(size.rows <= max_rows && size.rows <= size.tile_cap);
    prop_assert_eq!(by_memory, size.rows < max_rows);
    // Given values are kept.
    prop_assert!(size.sh_degree >= lowest);
    prop_assert!(tile_cap.is_none_or(|cap| size.tile_cap == cap.max(size.rows)));
    prop_assert!(image_cache.is_none_or(|cache| size.image_cache == cache));
    if by_memory {
        let more = request.size(size.rows + 1, size.sh_degree, pairs[0]);
        prop_assert!(run.bytes(&more) > memory);
    } else {
        let more = request.size(size.rows, size.sh_degree, pairs[2]);
        prop_assert!(size.tile_cap == more.tile_cap || run.bytes(&more) > memory);
        let images = RunSize { image_cache: run.all_image_bytes, ..size };
        prop_assert!(
            image_cache.is_some()
                || size.image_cache == run.all_image_bytes
                || run.bytes(&images) > memory
        );
    }
    // The degree is lowered only if too few rows fit at a higher one.
    let enough = 20_000.min(max_rows);
    prop_assert!(size.sh_degree == 3 || at_wanted_degree < enough);
    if size.sh_degree < 3 {
        let higher = request.size(enough, size.sh_degree + 1, pairs[0]);
        prop_assert!(run.bytes(&higher) > memory);
    }
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..Default::default() })]

    #[test]
    fn the_result_fits_and_one_more_row_does_not((run, request) in requests()) {
        check_fit(&run, &request)?;
    }

    #[test]
    fn more_memory_never_gives_a_smaller_model(
        run in runs(),
        memory in 0..2_000_000_000_u64,
        more in 0..200_000_000_u64,
    ) {
        let size = |memory| {
            let fit = run.fit(&request(&run, memory));
            fit.map(|fit| (fit.size.sh_degree, fit.size.rows))
        };
        prop_assert!(size(memory) <= size(memory + more));
    }

    #[test]
    fn min_memory_is_minimal(run in runs(), step in 1..2_000_000_u64) {
        let request = request(&run, 0);
        let bytes = |size: &RunSize| Ok::<_, Infallible>(run.bytes(size));
        let minimum = min_memory(&request, step, bytes).unwrap_or_else(|never| match never {});
        let minimum = minimum.expect("a number");
        prop_assert!(minimum.is_multiple_of(step));
        let fits = |memory| run.fit(&SizeRequest { memory, ..request.clone() }).is_some();
        prop_assert!(fits(minimum));
        prop_assert!(minimum < step || !fits(minimum - step));
    }
}

#[test]
fn a_degree_is_lowered_only_if_the_initial_rows_do_not_fit() {
    let run = ImaginaryRun {
        fixed: 0,
        per_row: 100,
        per_coefficient: 36,
        per_pair: 0,
        largest_image: 0,
        all_image_bytes: 0,
    };
    // 676, 424, 244 and 136 bytes a row at degrees 3 to 0; 20,000 initial rows.
    for (memory, degree, rows) in [
        (20_000 * 676, 3, 20_000),
        (20_000 * 676 - 1, 2, 31_872),
        (20_000 * 244, 1, 20_000),
        (19_999 * 136, 0, 19_984),
        (1_008 * 136, 0, 1_008),
    ] {
        let size = run.fit(&request(&run, memory)).expect("it fits").size;
        assert_eq!((size.sh_degree, size.rows), (degree, rows), "{memory}");
    }
    assert_eq!(run.fit(&request(&run, 1_008 * 136 - 1)), None);
}

#[test]
fn lists_are_no_longer_than_views_need() {
    let run = ImaginaryRun {
        fixed: 0,
        per_row: 0,
        per_coefficient: 0,
        per_pair: 0,
        largest_image: 0,
        all_image_bytes: 0,
    };
    let request = SizeRequest { enough_pairs: 100_000, ..request(&run, 0) };
    let caps = |rows| PAIRS.map(|pairs| request.size(rows, 0, pairs).tile_cap);
    assert_eq!(caps(1_000), [4_000, 8_000, 16_000]);
    assert_eq!(caps(10_000), [40_000, 80_000, 100_000]);
    assert_eq!(caps(50_000), [200_000; 3]);
}
