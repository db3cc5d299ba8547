//! Executes a compiled edit plan on the device, in place: encodes its operations as words, in chunks of fixed size,
//! and dispatches them. `shaders/apply.wgsl` documents the encoding. Encoding and dispatching are in one file because
//! they must agree on chunks and order.

use densify_policies::plan::{
    Decay, OpacityRule, ParentFate, Placement, RowOps, ScaleRule, Update,
};
use densify_policies::policy::Signal;

use super::GpuBackend;
use super::frame::folded_seed;
use super::launches::{Launch, RowLaunch};
use super::passes::{Record, Recorder};
use super::rows::Edited;
use super::sizes::OPS_BYTES;
use densify_core::gaussians::{ModelArray, logit, rgb_to_dc};

/// Words per chunk.
const CHUNK: usize = (OPS_BYTES / 4) as usize;
/// Words per operation.
const WORDS: usize = 20;
/// In place of a source row: the destination is cleared.
const NOTHING: u32 = u32::MAX;

fn scale_words(rule: ScaleRule) -> [u32; 4] {
    let (rule, factors) = match rule {
        ScaleRule::Uniform(factor) => (0, [factor, 1.0, 1.0]),
        ScaleRule::LongAxis { long, other } => (1, [long, other, 1.0]),
        ScaleRule::Axes(factors) => (2, factors),
        ScaleRule::Set(scale) => (3, [scale, 1.0, 1.0]),
    };
    let [a, b, c] = factors.map(|factor| factor.ln().to_bits());
    [rule, a, b, c]
}

/// A flag for the presence of the numbers, then the numbers.
fn optional_words(numbers: Option<[f32; 3]>) -> [u32; 4] {
    let [a, b, c] = numbers.unwrap_or_default().map(f32::to_bits);
    [u32::from(numbers.is_some()), a, b, c]
}

/// A normalised quaternion.
fn quaternion_words(quaternion: [f32; 4]) -> [u32; 4] {
    let length = quaternion.iter().map(|v| v * v).sum::<f32>().sqrt();
    quaternion.map(|v| (v / length).to_bits())
}

fn opacity_words(rule: OpacityRule, siblings: u32) -> [u32; 2] {
    match rule {
        OpacityRule::Same => [0, 0],
        OpacityRule::Set(opacity) => [1, logit(opacity).to_bits()],
        OpacityRule::Scaled(factor) => [2, factor.to_bits()],
        OpacityRule::Conserved => [3, (siblings.max(1) as f32).to_bits()],
    }
}

/// Encodes families, each a parent with its children, in chunks of `room` words: the operations, then the slots of the
/// children. A family too large for a chunk is split; only its last part rewrites the parent.
fn family_chunks(ops: &RowOps, room: usize) -> Vec<(usize, Vec<u32>)> {
    let mut chunks = Vec::new();
    let mut heads: Vec<[u32; WORDS]> = Vec::new();
    let mut slots: Vec<u32> = Vec::new();
    let mut close = |heads: &mut Vec<[u32; WORDS]>, slots: &mut Vec<u32>| {
        if heads.is_empty() {
            return;
        }
        let base = (heads.len() * WORDS) as u32;
        let mut words = Vec::with_capacity(room);
        for head in heads.iter_mut() {
            head[1] += base;
            words.extend_from_slice(head);
        }
        words.append(slots);
        chunks.push((heads.len(), words));
        heads.clear();
    };
    for family in &ops.families {
        let offspring = ops.offspring(family);
        let mut children = ops.children(family);
        let mut number = 1;
        let (placement, offset) = match offspring.placement {
            Placement::Offset(offset) => (0, offset.map(f32::to_bits)),
            Placement::Sampled => (1, [0; 3]),
            Placement::LongAxis { sigmas } => (2, [sigmas.to_bits(), 0, 0]),
            Placement::Axes(sigmas) => (3, sigmas.map(f32::to_bits)),
        };
        let [scale, a, b, c] = scale_words(offspring.scale);
        let [opacity, value] = opacity_words(offspring.opacity, offspring.siblings());
        let [w, x, y, z] = quaternion_words(offspring.turn);
        loop {
            let used = heads.len() * WORDS + slots.len();
            if used + WORDS >= room {
                close(&mut heads, &mut slots);
                continue;
            }
            let count = children.len().min(room - used - WORDS);
            let is_last = count == children.len();
            let becomes = is_last && offspring.parent == ParentFate::BecomesChild;
            let first = slots.len() as u32;
            heads.push([
                family.parent,
                first,
                count as u32,
                number,
                u32::from(becomes),
                placement,
                offset[0],
                offset[1],
                offset[2],
                scale,
                a,
                b,
                c,
                opacity,
                value,
                w,
                x,
                y,
                z,
                0,
            ]);
            slots.extend_from_slice(&children[..count]);
            children = &children[count..];
            number += count as u32;
            if is_last {
                break;
            }
        }
    }
    close(&mut heads, &mut slots);
    chunks
}

/// Splits a permutation, in which position i receives `order[i]`, into two rounds of disjoint swaps, each of which a
/// device can execute in parallel.
///
/// In a cycle of length k each element moves down by one place, which is the product of two reflections: j to −j,
/// then j to −j − 1 (modulo k).
fn rounds_of_swaps(order: &[u32]) -> [Vec<[u32; 2]>; 2] {
    let mut rounds = [Vec::new(), Vec::new()];
    let mut is_done = vec![false; order.len()];
    let mut cycle = Vec::new();
    for first in 0..order.len() as u32 {
        let mut row = first;
        cycle.clear();
        while !std::mem::replace(&mut is_done[row as usize], true) {
            cycle.push(row);
            row = order[row as usize];
        }
        let length = cycle.len();
        if length < 2 {
            continue;
        }
        // Places of a cycle are swapped if their indices add up to `sum`.
        for (round, sum) in rounds.iter_mut().zip([length, length - 1]) {
            let pairs = (sum + 1 - length..).map(|j| (j, sum - j));
            let pairs = pairs.take_while(|(j, other)| j < other);
            round.extend(pairs.map(|(j, other)| [cycle[j], cycle[other]]));
        }
    }
    rounds
}

impl GpuBackend {
    /// Uploads one chunk of operations and submits the dispatches that `encode` records.
    fn execute(&self, words: &[u32], encode: impl FnOnce(&mut Recorder<'_>)) {
        self.write("ops", bytemuck::cast_slice(words));
        self.submit(encode);
    }

    /// Copies rows (from, to), or clears them, in all arrays with one of these edit rules.
    fn copy_rows(&self, pairs: &[[u32; 2]], rules: &[Edited]) {
        let arrays = self.launches.copy_rows.iter().filter(|a| rules.contains(&a.edited));
        self.run_on_pairs(pairs, arrays);
    }

    /// Permutes the rows: row i becomes the former row `order[i]`.
    fn reorder(&self, order: &[u32]) {
        for round in rounds_of_swaps(order) {
            self.run_on_pairs(&round, self.launches.swap_rows.iter());
        }
    }

    /// Dispatches a kernel that works on pairs of rows, for each of these arrays.
    fn run_on_pairs<'a>(
        &self,
        pairs: &[[u32; 2]],
        arrays: impl Iterator<Item = &'a RowLaunch<Launch>> + Clone,
    ) {
        // Kernels count rows from the first that the array stores. Some arrays do not store frozen rows, which plans
        // never contain.
        let mut firsts: Vec<u32> = arrays.clone().map(|array| array.first_row).collect();
        firsts.sort_unstable();
        firsts.dedup();
        for (chunk, first) in
            pairs.chunks(CHUNK / 2).flat_map(|c| firsts.iter().map(move |f| (c, *f)))
        {
            let local = |row: u32| if row == NOTHING { NOTHING } else { row - first };
            let words: Vec<u32> = chunk.as_flattened().iter().map(|&row| local(row)).collect();
            self.execute(&words, |to| {
                for array in arrays.clone().filter(|array| array.first_row == first) {
                    let RowLaunch { launch, numbers, pitch: [row, number], .. } = array;
                    let count = chunk.len() as u32;
                    let immediates = [count, *numbers, *row, *number];
                    to.run(launch, immediates, (count * numbers).div_ceil(256));
                }
            });
        }
    }

    /// Executes operations of [`WORDS`] numbers each.
    fn run_ops(&self, launch: &Launch, ops: &[[u32; WORDS]]) {
        for chunk in ops.chunks(CHUNK / WORDS) {
            let count = chunk.len() as u32;
            self.execute(chunk.as_flattened(), |to| {
                to.run(launch, [count, 0, 0, 0], count.div_ceil(256));
            });
        }
    }

    /// Clears the SH bands of rows above their new degree, and the moments of these bands.
    fn drop_bands(&self, updates: &[(u32, Update)]) {
        for degree in 0..self.sizes.sh_degree {
            let of_degree = updates.iter().filter(|(_, u)| u.sh_degree == Some(degree));
            let rows: Vec<_> = of_degree.map(|&(row, _)| [NOTHING, row]).collect();
            let last = ModelArray::Sh.parameters(degree).end;
            let arrays = self.launches.copy_rows.iter();
            self.run_on_pairs(&rows, arrays.filter(|array| array.first_parameter >= last));
        }
    }

    /// Executes a checked plan, in the order of [`RowOps`].
    pub(super) fn edit(&mut self, ops: &RowOps, seed: u64, step: u32) {
        let launches = &self.launches;
        let clear = |row: u32| [NOTHING, row];
        for (count, words) in family_chunks(ops, CHUNK) {
            let immediates = [count as u32, folded_seed(seed), step, 0];
            self.execute(&words, |to| {
                to.run(launches.get("breed"), immediates, (count as u32).div_ceil(256));
            });
        }
        let mut inherited: Vec<[u32; 2]> = Vec::new();
        let mut cleared: Vec<[u32; 2]> = Vec::new();
        for family in &ops.families {
            let children = ops.children(family);
            inherited.extend(children.iter().map(|&slot| [family.parent, slot]));
            cleared.extend(children.iter().map(|&slot| clear(slot)));
            if family.fate() == ParentFate::BecomesChild {
                cleared.push(clear(family.parent));
            }
        }
        self.copy_rows(&inherited, &[Edited::Inherited]);
        let updates: Vec<_> = ops
            .updates
            .iter()
            .map(|&(row, update)| {
                let mut words = [0; WORDS];
                words[0] = row;
                words[1..5].copy_from_slice(&scale_words(update.scale));
                words[5..7].copy_from_slice(&opacity_words(update.opacity, 1));
                words[7..11].copy_from_slice(&optional_words(update.position));
                let colour = update.colour.map(|colour| colour.map(rgb_to_dc));
                words[11..15].copy_from_slice(&optional_words(colour));
                words
            })
            .collect();
        self.run_ops(launches.get("rewrite"), &updates);
        self.drop_bands(&ops.updates);
        cleared.extend(ops.updates.iter().filter(|(_, u)| !u.keep_moments).map(|u| clear(u.0)));
        let seeded: Vec<_> = ops.seeds.iter().map(|&(row, _)| clear(row)).collect();
        self.copy_rows(&seeded, &[Edited::Inherited]);
        let seeds: Vec<_> = ops
            .seeds
            .iter()
            .map(|&(row, seed)| {
                let mut words = [0; WORDS];
                words[0] = row;
                words[1..4].copy_from_slice(&seed.position.map(f32::to_bits));
                words[4..7].copy_from_slice(&seed.scales.map(|scale| scale.ln().to_bits()));
                words[7..11].copy_from_slice(&quaternion_words(seed.orientation));
                words[11] = logit(seed.opacity).to_bits();
                words[12..15].copy_from_slice(&seed.colour.map(|c| rgb_to_dc(c).to_bits()));
                words
            })
            .collect();
        self.run_ops(launches.get("sow"), &seeds);
        cleared.extend(seeded);
        self.copy_rows(&cleared, &[Edited::Cleared]);
        let moves: Vec<_> = ops.moves.iter().map(|&(from, to)| [from, to]).collect();
        self.copy_rows(&moves, &[Edited::Computed, Edited::Inherited, Edited::Cleared]);
        self.reorder(&ops.order());
        if let Some(decay) = ops.decay {
            self.decay(decay, ops.first_row as u32, ops.rows_after as u32);
        }
        if let Some(most) = ops.clamp_opacity {
            let rows = ops.rows_after as u32;
            let waits = u32::from(self.sizes.may_wait()[0]);
            let immediates = [rows, logit(most).to_bits(), waits, 0];
            let first = ops.first_row as u32;
            self.execute(&[first], |to| {
                to.run(launches.get("clamp_opacity"), immediates, rows.div_ceil(256));
            });
        }
        self.clear_planes(&self.planes.of_signals(ops.reset_signals));
        self.rows = ops.rows_after;
    }

    fn decay(&self, decay: Decay, first: u32, rows: u32) {
        let seen = self.planes.current(Signal::VisibleCount).filter(|_| decay.seen_only);
        let seen = seen.map_or(NOTHING, |plane| (plane as u64 * self.sizes.trained()) as u32);
        let shrunk = (1.0 - decay.scale).ln();
        let immediates = [rows, decay.opacity.to_bits(), shrunk.to_bits(), seen];
        self.execute(&[first], |to| {
            to.run(self.launches.get("decay"), immediates, rows.div_ceil(256));
        });
    }

    /// Clears planes of the signals.
    pub(super) fn clear_planes(&self, planes: &[usize]) {
        if planes.is_empty() {
            return;
        }
        let mut encoder = self.device.device.create_command_encoder(&Default::default());
        let bytes = 4 * self.sizes.trained();
        for &plane in planes {
            let from = plane as u64 * bytes;
            encoder.clear_buffer(self.buffers.get("signals"), from, Some(bytes));
        }
        self.device.queue.submit([encoder.finish()]);
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use densify_policies::plan::{EditPlan, NO_ROTATION, Offspring};
    use rand::SeedableRng;
    use rand::seq::SliceRandom;
    use rand_chacha::ChaCha8Rng;

    use super::*;

    #[test]
    fn two_rounds_of_swaps_make_any_permutation() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        for rows in [0, 1, 2, 3, 4, 5, 17, 300] {
            let mut order: Vec<u32> = (0..rows).collect();
            for _ in 0..4 {
                let mut found: Vec<u32> = (0..rows).collect();
                for round in rounds_of_swaps(&order) {
                    let mut seen = HashSet::new();
                    for [a, b] in round {
                        assert!(seen.insert(a) && seen.insert(b), "{order:?}: a row in two swaps");
                        found.swap(a as usize, b as usize);
                    }
                }
                assert_eq!(found, order);
                order.shuffle(&mut rng);
            }
        }
    }

    #[test]
    fn chunks_encode_every_family_completely() {
        let mut plan = EditPlan::new(40, 400);
        for row in 0..40 {
            let offspring = Offspring {
                children: 1 + row * row % 23,
                parent: if row % 2 == 0 { ParentFate::BecomesChild } else { ParentFate::Stays },
                placement: Placement::Sampled,
                scale: ScaleRule::Uniform(0.5),
                turn: NO_ROTATION,
                opacity: OpacityRule::Conserved,
            };
            let _ = plan.grow(row, offspring);
        }
        let ops = plan.compile();
        assert!(ops.families.len() > 10);
        for room in [40, 64, 1000, CHUNK] {
            let mut found: Vec<(u32, Vec<u32>, u32)> = Vec::new();
            for (count, words) in family_chunks(&ops, room) {
                assert!(words.len() <= room, "{} words in room for {room}", words.len());
                for op in words[..count * WORDS].as_chunks::<WORDS>().0 {
                    let [parent, first, children, number, becomes, ..] = *op;
                    let slots = &words[first as usize..][..children as usize];
                    match found.last_mut().filter(|(row, ..)| *row == parent) {
                        Some((_, all, rewritten)) => {
                            // A part continues where the last one ended, and the parent has not changed yet.
                            assert_eq!((number as usize, *rewritten), (all.len() + 1, 0));
                            all.extend_from_slice(slots);
                            *rewritten = becomes;
                        }
                        None => {
                            assert_eq!(number, 1);
                            found.push((parent, slots.to_vec(), becomes));
                        }
                    }
                }
            }
            let expected: Vec<_> = ops
                .families
                .iter()
                .map(|family| {
                    let becomes = family.fate() == ParentFate::BecomesChild;
                    (family.parent, ops.children(family).to_vec(), u32::from(becomes))
                })
                .collect();
            assert_eq!(found, expected, "room for {room}");
        }
    }
}
