//! Blocks of one degree and of several, against plain rows.

#![expect(clippy::float_cmp, reason = "numbers are moved, not computed")]

use super::*;

const CAPACITY: usize = 16 * 9;

/// 90 rows of different numbers in 9 blocks, of which the last three are empty.
fn filled(planes: usize) -> (Blocks, usize) {
    let mut blocks = Blocks::zeros(CAPACITY, planes);
    for row in 0..90 {
        for plane in 0..planes {
            blocks.set(row, plane, (1000 * row + plane) as f32);
        }
    }
    (blocks, 90)
}

#[test]
fn degrees_are_those_of_the_list_and_go_on_as_its_last() {
    let lists: [(&[u8], [u8; 8]); 6] = [
        (&[3, 3, 2, 2, 1, 0], [3, 3, 2, 2, 1, 0, 0, 0]),
        (&[3, 1, 1], [3, 1, 1, 1, 1, 1, 1, 1]),
        (&[3, 3, 2], [3, 3, 2, 2, 2, 2, 2, 2]),
        (&[2, 0], [2, 0, 0, 0, 0, 0, 0, 0]),
        (&[0], [0; 8]),
        (&[1], [1; 8]),
    ];
    for (list, expected) in lists {
        let degrees = Degrees::falling(list, 3);
        assert_eq!([0, 1, 2, 3, 4, 5, 6, 7].map(|block| degrees.of(block)), expected, "{list:?}");
        // The whole list says the same as its beginning.
        assert_eq!(Degrees::falling(&expected, 3), degrees, "{list:?}");
    }
    for (list, of_model) in [(&[3, 3][..], 3), (&[2, 2], 2), (&[0], 0), (&[], 1)] {
        assert_eq!(Degrees::falling(list, of_model), Degrees::ALL, "{list:?}");
    }
}

#[test]
fn what_is_dropped_is_gone_and_all_else_stays() {
    for (list, of_model) in [(&[3, 3, 2, 1, 1, 0][..], 3), (&[2, 1, 1, 1, 1, 1], 2), (&[0; 6], 1)] {
        let degrees = Degrees::falling(list, of_model);
        // Parameters, colours alone, bands 1 to 3 alone.
        for before in [0, plane::SH, plane::SH_REST] {
            let (mut blocks, rows) = filled(planes(of_model) - before);
            let whole = blocks.clone();
            blocks.drop_bands(rows, of_model, degrees);
            let held = |block: usize| planes(degrees.of(block)) - before;
            let mut next = 0;
            for block in 0..9 {
                for row in block * WIDTH..(block + 1) * WIDTH {
                    for plane in 0..planes(of_model) {
                        let kept = plane < held(block) && row < rows;
                        let expected = if kept { whole.get(row, plane) } else { 0.0 };
                        assert!(blocks.get(row, plane) == expected, "{list:?} {row} {plane}");
                    }
                }
                next += held(block) * WIDTH;
            }
            assert_eq!(blocks.held(), 4 * next as u64, "{list:?}: not given back");
            assert_eq!(blocks.held() < whole.held(), held(8) < whole.planes(), "{list:?}");
        }
        // What has no colour has nothing to lose.
        let (mut blocks, rows) = filled(8);
        blocks.drop_bands(rows, of_model, degrees);
        assert_eq!(blocks.held(), filled(8).0.held());
    }
}

#[test]
fn kernels_find_the_blocks_that_rows_are_in() {
    let (mut blocks, rows) = filled(planes(3));
    for degrees in [Degrees::ALL, Degrees::falling(&[3, 3, 2, 1, 1, 0], 3)] {
        blocks.drop_bands(rows, 3, degrees);
        let copy = blocks.clone();
        let first = |block: usize| copy.get(block * WIDTH, plane::SH_REST - 1);
        let view = blocks.view(rows);
        for block in 0..6 {
            let held = planes(degrees.of(block)) * WIDTH;
            for numbers in [view.block(block), view.part(block..6).block(0)] {
                assert_eq!(numbers.len(), held);
                assert!(numbers[(plane::SH_REST - 1) * WIDTH] == first(block), "{block}");
            }
        }
        let mut tasks = blocks.tasks(rows);
        assert_eq!(tasks.len(), 1);
        for block in 0..6 {
            assert!(tasks[0].block(block)[(plane::SH_REST - 1) * WIDTH] == first(block));
        }
    }
}

/// More blocks than a task has, and the boundary between degrees within a task.
#[test]
fn tasks_are_cut_where_blocks_begin() {
    let (rows, blocks) = (16 * 40 - 3, 40);
    let list: Vec<u8> = (0..blocks).map(|block| 3 - (block / 11) as u8).collect();
    let degrees = Degrees::falling(&list, 3);
    let mut all: Blocks = Blocks::zeros(rows, planes(3));
    for row in 0..rows {
        all.set(row, 5, row as f32);
    }
    all.drop_bands(rows, 3, degrees);
    let sizes: Vec<usize> = all.tasks(rows).iter().map(|task| task.data.len()).collect();
    assert_eq!(sizes.iter().sum::<usize>(), all.of_rows(rows).len());
    for (task, mut blocks) in all.tasks(rows).into_iter().enumerate() {
        for block in 0..BLOCKS_PER_TASK.min(list.len() - task * BLOCKS_PER_TASK) {
            let of_all = task * BLOCKS_PER_TASK + block;
            let numbers = blocks.block(block);
            assert_eq!(numbers.len(), planes(list[of_all]) * WIDTH);
            assert!(numbers[5 * WIDTH] == (of_all * WIDTH) as f32, "task {task}, block {block}");
        }
    }
}

#[test]
fn a_row_has_what_its_block_holds() {
    let (mut blocks, rows) = filled(planes(3));
    blocks.drop_bands(rows, 3, Degrees::falling(&[3, 2, 2, 2, 1, 1], 3));
    let whole = filled(planes(3)).0;
    let row = |blocks: &Blocks, row: usize| blocks.to_rows(row..row + 1, 0..planes(3));
    let cut = |mut numbers: Vec<f32>, degree: u8| {
        numbers[planes(degree)..].fill(0.0);
        numbers
    };
    // Down, up, and beyond the last row.
    blocks.copy_row(3, 70);
    assert!(row(&blocks, 70) == cut(row(&whole, 3), 1));
    blocks.copy_row(70, 4);
    assert!(row(&blocks, 4) == cut(row(&whole, 3), 1));
    blocks.copy_row(5, 140);
    assert!(row(&blocks, 140) == cut(row(&whole, 5), 1));
    blocks.swap_rows(6, 20);
    assert!(
        row(&blocks, 6) == cut(row(&whole, 20), 2) && row(&blocks, 20) == cut(row(&whole, 6), 2)
    );
    blocks.clear_row(6);
    assert!(row(&blocks, 6).iter().all(|x| *x == 0.0));
    assert!(row(&blocks, 7) == row(&whole, 7) && row(&blocks, 71) == cut(row(&whole, 71), 1));
}
