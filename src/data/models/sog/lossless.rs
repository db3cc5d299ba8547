//! Lossless WebP (VP8L, RFC 9649) for images whose pixels are numbers. Neighbouring pixels are Gaussians near each
//! other, so that the pixel to the left predicts the next; channels are independent.
//!
//! `image-webp` always subtracts the green channel from the others and predicts from above; this encoder chooses the
//! transforms that give the smallest file. It writes no references to earlier pixels, as pixels hardly ever repeat.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use Predictor::{Above, Left, Mean, Select};

/// Number of symbols in each channel's code; green shares its code with the lengths of references, which are not used.
const SYMBOLS: [usize; 4] = [280, 256, 256, 256];
/// Number of symbols in the code of distances.
const DISTANCES: usize = 40;
/// Channels of RGBA in the order of their codes.
const CHANNELS: [usize; 4] = [1, 0, 2, 3];
/// Length of the longest code word `[bits]`.
const MAX_BITS: u8 = 15;
/// Order in which the code of lengths stores its own lengths.
const LENGTH_ORDER: [usize; 19] =
    [17, 18, 0, 1, 2, 3, 4, 5, 16, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15];

/// A predictor of pixels, with its number in the format.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
enum Predictor {
    Left = 1,
    Above = 2,
    Mean = 7,
    Select = 11,
}

/// The transforms that are applied to the pixels.
#[derive(Debug, Clone, Copy)]
struct Transforms {
    subtracts_green: bool,
    predictor: Option<Predictor>,
}

/// Writes a stream of bits, the lowest first.
#[derive(Default)]
struct BitWriter {
    bytes: Vec<u8>,
    pending: u64,
    count: u32,
}

impl BitWriter {
    fn put(&mut self, value: u64, bits: u8) {
        self.pending |= value << self.count;
        self.count += u32::from(bits);
        while self.count >= 8 {
            self.bytes.push(self.pending as u8);
            self.pending >>= 8;
            self.count -= 8;
        }
    }

    fn finish(mut self) -> Vec<u8> {
        if self.count > 0 {
            self.bytes.push(self.pending as u8);
        }
        self.bytes
    }
}

/// Encodes an image whose width and height are 1 to 16,384 `[px]`. Shape of `rgba`: `[height, width, 4]`.
pub(super) fn encode(rgba: &[u8], (width, height): (usize, usize)) -> Vec<u8> {
    let pixels = rgba.as_chunks::<4>().0;
    let is_opaque = pixels.iter().all(|pixel| pixel[3] == 255);
    let predictors = [None, Some(Left), Some(Above), Some(Mean), Some(Select)];
    let candidates = predictors.into_iter().flat_map(|predictor| {
        [false, true].map(|subtracts_green| Transforms { subtracts_green, predictor })
    });
    let cost = |transforms: &Transforms| {
        let counts = histograms(&residuals(pixels, width, *transforms));
        counts.iter().map(|counts| entropy(counts)).sum::<f64>()
    };
    let costs = candidates.map(|transforms| (cost(&transforms), transforms));
    let best = costs.min_by(|a, b| a.0.total_cmp(&b.0));
    let none = Transforms { subtracts_green: false, predictor: None };
    let transforms = best.map_or(none, |(_, transforms)| transforms);

    let mut to = BitWriter::default();
    to.put(0x2f, 8);
    to.put(width as u64 - 1, 14);
    to.put(height as u64 - 1, 14);
    to.put(u64::from(!is_opaque), 1);
    to.put(0, 3);
    // Each transform is a bit of 1, its number, and its data.
    if transforms.subtracts_green {
        to.put(0b10 << 1 | 1, 3);
    }
    if let Some(predictor) = transforms.predictor {
        to.put(1, 3);
        // One predictor for all blocks of 512 x 512 pixels: an image with a pixel per block, whose green channel is the
        // predictor's number, without a colour cache.
        to.put(0b111, 3);
        to.put(0, 1);
        put_single(&mut to, predictor as u8);
        (0..4).for_each(|_| put_single(&mut to, 0));
    }
    // No more transforms, no colour cache, one group of codes.
    to.put(0, 3);
    let pixels = residuals(pixels, width, transforms);
    let counts = histograms(&pixels);
    let codes: [Vec<(u16, u8)>; 4] =
        std::array::from_fn(|i| put_code(&mut to, &counts[CHANNELS[i]], SYMBOLS[i]));
    let _ = put_code(&mut to, &[], DISTANCES);
    for pixel in &pixels {
        for (code, channel) in codes.iter().zip(CHANNELS) {
            let (bits, length) = code[usize::from(pixel[channel])];
            to.put(bits.into(), length);
        }
    }
    riff_file(&to.finish())
}

/// Wraps the data in a RIFF file.
fn riff_file(data: &[u8]) -> Vec<u8> {
    let padding = data.len() % 2;
    let size = |bytes: usize| (bytes as u32).to_le_bytes();
    let mut file =
        [b"RIFF", &size(12 + data.len() + padding)[..], b"WEBPVP8L", &size(data.len())].concat();
    file.extend_from_slice(data);
    file.resize(file.len() + padding, 0);
    file
}

/// The pixels after the transforms.
fn residuals(pixels: &[[u8; 4]], width: usize, transforms: Transforms) -> Vec<[u8; 4]> {
    let at = |index: usize| {
        let [r, g, b, a] = pixels[index];
        if transforms.subtracts_green {
            [r.wrapping_sub(g), g, b.wrapping_sub(g), a]
        } else {
            [r, g, b, a]
        }
    };
    let Some(predictor) = transforms.predictor else {
        return (0..pixels.len()).map(at).collect();
    };
    let predicted = |index: usize| match (index % width, index / width) {
        (0, 0) => [0, 0, 0, 255],
        (_, 0) => at(index - 1),
        (0, _) => at(index - width),
        _ => {
            let (left, above) = (at(index - 1), at(index - width));
            match predictor {
                Left => left,
                Above => above,
                Mean => {
                    std::array::from_fn(|i| ((u16::from(left[i]) + u16::from(above[i])) / 2) as u8)
                }
                Select => {
                    let corner = at(index - width - 1);
                    let distance = |pixel: &[u8; 4]| -> u32 {
                        pixel.iter().zip(corner).map(|(a, b)| u32::from(a.abs_diff(b))).sum()
                    };
                    if distance(&above) < distance(&left) { left } else { above }
                }
            }
        }
    };
    let residual = |index: usize| {
        let (pixel, predicted) = (at(index), predicted(index));
        std::array::from_fn(|i| pixel[i].wrapping_sub(predicted[i]))
    };
    (0..pixels.len()).map(residual).collect()
}

/// Histograms of the channels.
fn histograms(pixels: &[[u8; 4]]) -> [[u32; 256]; 4] {
    let mut counts = [[0; 256]; 4];
    for pixel in pixels {
        for (counts, &value) in counts.iter_mut().zip(pixel) {
            counts[usize::from(value)] += 1;
        }
    }
    counts
}

/// Entropy of a histogram `[bits]`, the size of an ideal code.
fn entropy(counts: &[u32]) -> f64 {
    let total: f64 = counts.iter().map(|&count| f64::from(count)).sum();
    let used = counts.iter().filter(|count| **count > 0).map(|&count| f64::from(count));
    used.map(|count| count * (total / count).log2()).sum()
}

/// Writes a code with one symbol, whose code word has no bits.
fn put_single(to: &mut BitWriter, symbol: u8) {
    // A simple code with one symbol of eight bits.
    to.put(0b101, 3);
    to.put(symbol.into(), 8);
}

/// Writes a code for values with these counts; returns the bits and the length of each code word.
fn put_code(to: &mut BitWriter, counts: &[u32], symbols: usize) -> Vec<(u16, u8)> {
    let used: Vec<usize> = (0..counts.len()).filter(|&symbol| counts[symbol] > 0).collect();
    if let [] | [_] = used[..] {
        put_single(to, used.first().map_or(0, |&symbol| symbol as u8));
        return vec![(0, 0); 256];
    }
    let mut lengths = code_lengths(counts, MAX_BITS);
    lengths.resize(symbols, 0);
    to.put(0, 1);
    put_lengths(to, &lengths);
    codes(&lengths)
}

/// Writes the lengths of a code's words, which are themselves coded, with runs of zeros.
fn put_lengths(to: &mut BitWriter, lengths: &[u8]) {
    // A symbol, then its extra bits and their number.
    let mut tokens: Vec<(usize, u64, u8)> = Vec::new();
    let mut rest = lengths;
    while let Some(&length) = rest.first() {
        let zeros = rest.iter().take_while(|length| **length == 0).count().min(138);
        let (run, token) = match zeros {
            0..3 => (1, (length.into(), 0, 0)),
            3..11 => (zeros, (17, zeros as u64 - 3, 3)),
            _ => (zeros, (18, zeros as u64 - 11, 7)),
        };
        tokens.push(token);
        rest = &rest[run..];
    }
    let mut counts = [0; 19];
    tokens.iter().for_each(|(symbol, ..)| counts[*symbol] += 1);
    let mut own_lengths = code_lengths(&counts, 7);
    // The words of a code with a single symbol have no bits, but their length is written as 1.
    let is_single = counts.iter().filter(|count| **count > 0).count() == 1;
    if is_single {
        own_lengths = counts.map(|count| u8::from(count > 0)).to_vec();
    }
    let last = LENGTH_ORDER.iter().rposition(|&at| own_lengths[at] > 0).unwrap_or(0).max(3);
    to.put(last as u64 - 3, 4);
    LENGTH_ORDER[..=last].iter().for_each(|&at| to.put(own_lengths[at].into(), 3));
    // A length follows for every symbol.
    to.put(0, 1);
    let codes = codes(&own_lengths);
    for (symbol, more, bits) in tokens {
        let (code, length) = codes[symbol];
        to.put(code.into(), if is_single { 0 } else { length });
        to.put(more, bits);
    }
}

/// The lengths of a Huffman code (1952) with words of at most `max_bits` bits; 0 for values that do not occur. The
/// counts are flattened until no word is too long.
fn code_lengths(counts: &[u32], max_bits: u8) -> Vec<u8> {
    let mut counts = counts.to_vec();
    loop {
        let lengths = huffman(&counts);
        if lengths.iter().all(|length| *length <= max_bits) {
            return lengths;
        }
        for count in counts.iter_mut().filter(|count| **count > 0) {
            *count = *count / 2 + 1;
        }
    }
}

fn huffman(counts: &[u32]) -> Vec<u8> {
    // A node is a count and the index of a symbol or pair; ties go to the smaller index.
    let used = (0..counts.len()).filter(|&symbol| counts[symbol] > 0);
    let mut heap: BinaryHeap<Reverse<(u64, usize)>> =
        used.map(|symbol| Reverse((counts[symbol].into(), symbol))).collect();
    let mut parents = vec![usize::MAX; counts.len()];
    while let (Some(Reverse(a)), true) = (heap.pop(), !heap.is_empty()) {
        let Some(Reverse(b)) = heap.pop() else { break };
        let pair = parents.len();
        parents.push(usize::MAX);
        (parents[a.1], parents[b.1]) = (pair, pair);
        heap.push(Reverse((a.0 + b.0, pair)));
    }
    let parent = |&node: &usize| Some(parents[node]).filter(|&up| up != usize::MAX);
    let depth = |symbol: usize| std::iter::successors(Some(symbol), parent).count() - 1;
    let length = |symbol: usize| if counts[symbol] > 0 { depth(symbol) as u8 } else { 0 };
    (0..counts.len()).map(length).collect()
}

/// The words of a canonical code with these lengths, ordered by length, then symbol; the first bit is the lowest.
fn codes(lengths: &[u8]) -> Vec<(u16, u8)> {
    let mut next = 0u16;
    let mut codes = vec![(0, 0); lengths.len()];
    for length in 1..=MAX_BITS {
        next <<= 1;
        for (code, _) in codes.iter_mut().zip(lengths).filter(|(_, own)| **own == length) {
            *code = (next.reverse_bits() >> (16 - length), length);
            next += 1;
        }
    }
    codes
}

#[cfg(test)]
mod tests {
    use super::*;

    fn encoded_length(width: usize, height: usize, pixel: impl Fn(usize) -> [u8; 4]) -> usize {
        let rgba: Vec<u8> = (0..width * height).flat_map(&pixel).collect();
        let file = encode(&rgba, (width, height));
        let read = image::load_from_memory(&file).expect("a picture").into_rgba8();
        assert_eq!((read.width() as usize, read.height() as usize), (width, height));
        assert!(read.into_raw() == rgba, "{width}x{height}");
        file.len()
    }

    /// Pseudo-random bytes.
    fn noise(at: usize) -> u8 {
        ((at as u64 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 40) as u8
    }

    #[test]
    fn every_image_round_trips() {
        for (width, height) in [(1, 1), (4, 1), (1, 5), (3, 2), (520, 517), (64, 1040)] {
            for alpha in [255, 7] {
                // One colour, two, a few, gradients along and across, waves, noise in all channels or one.
                encoded_length(width, height, |_| [9, 200, 0, alpha]);
                encoded_length(width, height, |at| [0, (at % 2) as u8, 255, alpha]);
                encoded_length(width, height, |at| [(at % 5) as u8, 1, 2, alpha]);
                encoded_length(width, height, |at| {
                    [at as u8, (at >> 8) as u8, (at * 31) as u8, alpha]
                });
                encoded_length(width, height, |at| {
                    [(at / width) as u8, (at % width) as u8, 3, alpha]
                });
                encoded_length(width, height, |at| {
                    let wave = (127.0 + 120.0 * (at as f32 / 99.0).sin()) as u8;
                    [wave, 255 - wave, noise(at) % 3, alpha]
                });
                encoded_length(width, height, |at| {
                    [noise(4 * at), noise(4 * at + 1), noise(4 * at + 2), noise(at)]
                });
            }
        }
    }

    #[test]
    fn code_lengths_are_limited_and_leave_no_word_unused() {
        // Fibonacci numbers make the longest words.
        let mut counts = vec![1, 1];
        while counts.len() < 40 {
            counts.push(counts[counts.len() - 1] + counts[counts.len() - 2]);
        }
        for max in [7, 15] {
            let lengths = code_lengths(&counts, max);
            assert!(lengths.iter().all(|length| (1..=max).contains(length)), "{lengths:?}");
            let words: f64 = lengths.iter().map(|&length| 0.5_f64.powi(length.into())).sum();
            assert!((words - 1.0).abs() < 1e-12, "{lengths:?}");
        }
        assert_eq!(huffman(&[4, 0, 2, 1, 1]), [1, 0, 2, 3, 3]);
    }

    #[test]
    fn gradients_compress_well() {
        // Waves along the rows of the image, independent in each channel.
        let pixel = |at: usize| {
            let wave = |length: f32| (127.0 + 120.0 * (at as f32 / length).sin()) as u8;
            [wave(50.0), noise(at), wave(37.0), 255]
        };
        let bytes = encoded_length(100, 100, pixel);
        // Noise takes a byte per pixel; differences of −4 to 4 in the two other channels take three bits at most.
        assert!(bytes < 10_000 + 2 * 10_000 * 3 / 8 + 1_000, "{bytes}");
    }
}
