//! Codebooks with the least squared error, by Lloyd's iteration (1957) over a histogram.

use super::layout::CODEBOOK as ENTRIES;

/// Number of intervals of the histogram.
const BINS: usize = 1 << 14;
/// Maximum number of iterations; from this starting point, few are usually needed.
const ITERATIONS: usize = 50;

/// A codebook, in ascending order.
#[derive(Debug)]
pub(super) struct Codebook(Vec<f32>);

impl Codebook {
    /// Fits a codebook to finite values; `weight` gives the weight of a value by its index.
    pub(super) fn fit(values: &[f32], weight: impl Fn(usize) -> f32) -> Self {
        let min = values.iter().copied().fold(f32::INFINITY, f32::min);
        let max = values.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        // All values are equal, or there are none.
        if max <= min {
            return Self(vec![min; ENTRIES]);
        }
        let (min, extent) = (f64::from(min), f64::from(max) - f64::from(min));
        // The sum of the weights of each bin's values, and the sum of weight times value.
        let mut bins = vec![[0.0f64; 2]; BINS];
        for (index, &value) in values.iter().enumerate() {
            let bin = ((f64::from(value) - min) / extent * BINS as f64) as usize;
            let weight = f64::from(weight(index));
            let bin = &mut bins[bin.min(BINS - 1)];
            *bin = [bin[0] + weight, bin[1] + weight * f64::from(value)];
        }
        // The optimal density of entries is proportional to the cube root of the density of values (Panter and Dite
        // 1951).
        let density: Vec<f64> = bins.iter().map(|bin| bin[0].cbrt()).collect();
        let total: f64 = density.iter().sum();
        let (mut book, mut sum) = (Vec::with_capacity(ENTRIES), 0.0);
        for (bin, share) in density.iter().enumerate() {
            sum += share;
            while sum > (book.len() as f64 + 0.5) / ENTRIES as f64 * total && book.len() < ENTRIES {
                book.push(min + (bin as f64 + 0.5) / BINS as f64 * extent);
            }
        }
        book.resize(ENTRIES, min + extent);
        for _ in 0..ITERATIONS {
            if !improve(&mut book, &bins) {
                break;
            }
        }
        Self(book.into_iter().map(|value| value as f32).collect())
    }

    /// The numbers of the codebook.
    pub(super) fn values(&self) -> &[f32] {
        &self.0
    }

    /// Index of the nearest number.
    pub(super) fn nearest(&self, value: f32) -> u8 {
        let above = self.0.partition_point(|&entry| entry < value).min(ENTRIES - 1);
        let below = above.saturating_sub(1);
        let is_below = value - self.0[below] < self.0[above] - value;
        (if is_below { below } else { above }) as u8
    }
}

/// Moves each number to the mean of the values nearest to it; returns true if a number changed.
fn improve(book: &mut [f64], bins: &[[f64; 2]]) -> bool {
    let mut sums = vec![[0.0f64; 2]; book.len()];
    let mut entry = 0;
    for bin in bins.iter().filter(|bin| bin[0] > 0.0) {
        let value = bin[1] / bin[0];
        while book.get(entry + 1).is_some_and(|next| value - book[entry] > next - value) {
            entry += 1;
        }
        sums[entry] = [sums[entry][0] + bin[0], sums[entry][1] + bin[1]];
    }
    let mut moved = false;
    for (value, sum) in book.iter_mut().zip(sums) {
        if sum[0] > 0.0 {
            let mean = sum[1] / sum[0];
            moved |= mean.to_bits() != value.to_bits();
            *value = mean;
        }
    }
    book.sort_by(f64::total_cmp);
    moved
}

#[cfg(test)]
#[allow(clippy::float_cmp, reason = "results are exact")]
mod tests {
    use super::*;

    #[test]
    fn few_values_are_kept_and_many_are_close_to_an_entry() {
        let few: Vec<f32> = (0..200).map(|i| (i as f32).sqrt() - 3.0).collect();
        let book = Codebook::fit(&few, |_| 1.0);
        for &value in &few {
            let found = book.values()[usize::from(book.nearest(value))];
            assert!((found - value).abs() < 2e-3, "{found} for {value}");
        }
        // Most values lie near 0, so the codebook's entries must too.
        let many: Vec<f32> = (0..100_000).map(|i| ((i as f32 / 50_000.0) - 1.0).powi(3)).collect();
        let book = Codebook::fit(&many, |_| 1.0);
        let error = |&v: &f32| (book.values()[usize::from(book.nearest(v))] - v).powi(2);
        let rms = (many.iter().map(error).sum::<f32>() / many.len() as f32).sqrt();
        // The smallest possible mean square, (∫∛density)³/12/256² (Panter and Dite), is 0.0019²; even spacing has
        // 0.00226².
        assert!(rms < 0.001_95, "{rms}");
    }

    #[test]
    fn values_with_more_weight_get_more_entries() {
        let values: Vec<f32> = (0..20_000).map(|i| i as f32 / 20_000.0).collect();
        let book = Codebook::fit(&values, |i| if i < 10_000 { 1000.0 } else { 1.0 });
        let low = book.values().iter().filter(|&&v| v < 0.5).count();
        assert!(low > 200, "{low}");
    }

    #[test]
    fn equal_values_give_a_constant_codebook() {
        assert_eq!(Codebook::fit(&[2.5; 7], |_| 1.0).values(), [2.5; 256]);
        assert_eq!(Codebook::fit(&[2.5], |_| 1.0).nearest(2.5), 0);
    }
}
