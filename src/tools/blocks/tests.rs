//! Tests of the cells and of the plan's file.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::cells::divide;
use super::*;

/// Points that are denser towards one corner, and their work.
fn points(count: usize) -> (Vec<[f64; 2]>, Vec<f64>) {
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let at = (0..count).map(|_| [0, 1].map(|_| rng.random::<f64>().powi(3))).collect();
    let work = (0..count).map(|_| 1.0 + 4.0 * rng.random::<f64>()).collect();
    (at, work)
}

#[test]
fn cells_cover_the_ground_once_and_have_equal_work() {
    let (at, work) = points(5_000);
    let total: f64 = work.iter().sum();
    for grid in [[1, 1], [4, 1], [2, 2], [3, 5]] {
        let cells = divide(&at, &work, grid);
        assert_eq!(cells.len(), grid[0] * grid[1]);
        let far = [[-1e9, 1e9], [1e9, -1e9], [0.5, -1e9]];
        for point in at.iter().chain(&far) {
            let holders = cells.iter().filter(|cell| cell.contains(*point)).count();
            assert_eq!(holders, 1, "{grid:?}, {point:?}");
        }
        for cell in &cells {
            let inside = at.iter().zip(&work).filter(|(at, _)| cell.contains(**at));
            let share = inside.map(|(_, work)| work).sum::<f64>() / total;
            let even = 1.0 / cells.len() as f64;
            assert!((share - even).abs() < 0.02 * even, "{grid:?}: {share} of {even}");
        }
    }
}

#[test]
fn points_at_one_place_stay_in_one_cell() {
    let cells = divide(&[[1.0, 2.0]; 9], &[1.0; 9], [2, 2]);
    assert_eq!(cells.iter().filter(|cell| cell.contains([1.0, 2.0])).count(), 1);
}

#[test]
fn a_margin_widens_a_cell_on_both_sides() {
    let cell = Cell { low: [0.0, f64::NEG_INFINITY], high: [1.0, 2.0] };
    let wide = cell.widened([0.25, 0.5]);
    assert!(wide.contains([-0.25, -1e9]) && wide.contains([1.2, 2.4]));
    assert!(
        !wide.contains([-0.3, 0.0]) && !wide.contains([1.25, 0.0]) && !wide.contains([0.5, 2.5])
    );
}

#[test]
fn grids_of_blocks_are_parsed() {
    assert_eq!("4".parse(), Ok(Grid::Fixed([4, 1])));
    assert_eq!("3x2".parse(), Ok(Grid::Fixed([3, 2])));
    assert_eq!("auto".parse(), Ok(Grid::Auto));
    for bad in ["", "0", "0x2", "2x", "x", "-1", "2x2x2", "1001", "many"] {
        assert!(bad.parse::<Grid>().is_err(), "{bad:?}");
    }
}

/// A plan of three blocks.
pub(super) fn example() -> BlockPlan {
    let block = |name: &str, low: f64, high: f64| Block {
        name: name.to_owned(),
        rows: 1_000,
        budget: 1_200,
        views: 12,
        iterations: 300,
        memory: (50 << 20) + 1,
        work: 1.0 / 3.0,
        cell: Cell { low: [low, f64::NEG_INFINITY], high: [high, f64::INFINITY] },
    };
    let ground = Ground { origin: DVec3::ZERO, u: DVec3::X, v: DVec3::Y };
    let infinite = f64::INFINITY;
    BlockPlan {
        densify: "0".to_owned(),
        scene: "/data/a city".into(),
        rows: 3_000,
        sh_degree: 2,
        threads: 4,
        margin: [0.5, 0.5],
        merge_memory: 1 << 20,
        ground,
        coarse: Coarse { rows: 1_000, iterations: 500, memory: 20 << 20 },
        block: vec![
            block("block-0-0", -infinite, 0.0),
            block("block-1-0", 0.0, 1.0),
            block("block-2-0", 1.0, infinite),
        ],
    }
}

#[test]
fn a_plan_is_read_as_written_and_block_names_cannot_leave_its_folder() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(PLAN_FILE);
    let absent = BlockPlan::read(folder.path()).unwrap_err();
    assert!(absent.code == 2 && absent.to_string().contains("blocks plan"), "{absent:?}");
    let mut plan = example();
    std::fs::write(&path, toml::to_string(&plan).unwrap()).unwrap();
    assert_eq!(BlockPlan::read(folder.path()), Ok(plan.clone()));
    for bad in ["../../etc", "", "a/b", "a b"] {
        plan.block[1].name = bad.to_owned();
        std::fs::write(&path, toml::to_string(&plan).unwrap()).unwrap();
        assert_eq!(BlockPlan::read(folder.path()).unwrap_err().code, 2, "{bad:?}");
    }
    assert!(example().task("block-3-0").unwrap_err().to_string().contains("block-2-0"));
}
