//! Decompresses the GPS times of LAZ points (version 2 of LASzip's item GPSTIME11), which lie between the fields that
//! are needed.
//!
//! The crate has a decoder too, which calls itself whenever the sequence of times changes: a damaged file, in which this
//! happens often, would overflow the stack.

use std::io::{self, Read};

use laz::decoders::ArithmeticDecoder;
use laz::decompressors::{IntegerDecompressor, IntegerDecompressorBuilder};
use laz::models::{ArithmeticModel, ArithmeticModelBuilder};
use laz::record::FieldDecompressor;

/// Number of sequences. Times of several flight lines or lasers may alternate, each with differences of its own.
const SEQUENCES: usize = 4;
/// Largest and smallest multiple of the last difference that have symbols of their own, which are 0 to 500 and 501 to
/// 510.
const LARGEST: i32 = 500;
const SMALLEST: i32 = -10;
/// The symbols after those of the multiples: the same time again, a new sequence, and changes to other sequences.
const UNCHANGED: u32 = 511;
const NEW: u32 = 512;
/// Number of symbols after a difference of zero, and after another one.
const SYMBOLS: [u32; 2] = [6, 516];
/// So many extreme multiples in a row replace the last difference.
const PATIENCE: u32 = 4;

/// A sequence of times.
#[derive(Clone, Copy, Default)]
struct Sequence {
    /// The last time, whose bits are those of an `f64`.
    time: i64,
    /// The difference that multiples refer to.
    difference: i32,
    /// Number of extreme multiples since the difference changed.
    extremes: u32,
}

/// The decoder of the times of a chunk.
pub(super) struct GpsTimes {
    after_zero: ArithmeticModel,
    after_other: ArithmeticModel,
    numbers: IntegerDecompressor,
    sequences: [Sequence; SEQUENCES],
    current: usize,
    newest: usize,
}

impl GpsTimes {
    pub(super) fn new() -> Self {
        let [after_zero, after_other] =
            SYMBOLS.map(|symbols| ArithmeticModelBuilder::new(symbols).build());
        let numbers = IntegerDecompressorBuilder::new().bits(32).contexts(9).build_initialized();
        let sequences = [Sequence::default(); SEQUENCES];
        Self { after_zero, after_other, numbers, sequences, current: 0, newest: 0 }
    }

    /// Decodes the next time, or a change to another sequence, which is followed by the time. Returns true for a time.
    fn step<R: Read>(&mut self, decoder: &mut ArithmeticDecoder<R>) -> io::Result<bool> {
        let sequence = &mut self.sequences[self.current];
        if sequence.difference == 0 {
            match decoder.decode_symbol(&mut self.after_zero)? {
                0 => {}
                1 => {
                    sequence.difference = self.numbers.decompress(decoder, 0, 0)?;
                    sequence.time = sequence.time.wrapping_add(sequence.difference.into());
                    sequence.extremes = 0;
                }
                2 => self.begin_sequence(decoder)?,
                symbol => return Ok(self.change(symbol - 2)),
            }
            return Ok(true);
        }
        let symbol = decoder.decode_symbol(&mut self.after_other)?;
        match symbol {
            ..UNCHANGED => {}
            UNCHANGED => return Ok(true),
            NEW => return self.begin_sequence(decoder).map(|()| true),
            _ => return Ok(self.change(symbol - NEW)),
        }
        let symbol = symbol as i32;
        let multiple = if symbol > LARGEST { LARGEST - symbol } else { symbol };
        let context = match multiple {
            0 => 7,
            1 => 1,
            2..10 => 2,
            10..LARGEST => 3,
            LARGEST.. => 4,
            SMALLEST => 6,
            _ => 5,
        };
        let predicted = multiple.wrapping_mul(sequence.difference);
        let difference = self.numbers.decompress(decoder, predicted, context)?;
        sequence.time = sequence.time.wrapping_add(difference.into());
        match multiple {
            1 => sequence.extremes = 0,
            0 | LARGEST | SMALLEST => sequence.extremes += 1,
            _ => {}
        }
        if sequence.extremes == PATIENCE {
            (sequence.difference, sequence.extremes) = (difference, 0);
        }
        Ok(true)
    }

    /// Decodes a time that is far from all sequences. It replaces the oldest one.
    fn begin_sequence<R: Read>(&mut self, decoder: &mut ArithmeticDecoder<R>) -> io::Result<()> {
        let upper = (self.sequences[self.current].time >> 32) as i32;
        let upper = self.numbers.decompress(decoder, upper, 8)?;
        let time = i64::from(upper) << 32 | i64::from(decoder.read_int()?);
        self.newest = (self.newest + 1) % SEQUENCES;
        self.current = self.newest;
        self.sequences[self.current] = Sequence { time, ..Sequence::default() };
        Ok(())
    }

    /// Makes another sequence the current one. Returns false, as no time was decoded.
    fn change(&mut self, by: u32) -> bool {
        self.current = (self.current + by as usize) % SEQUENCES;
        false
    }
}

impl<R: Read> FieldDecompressor<R> for GpsTimes {
    fn size_of_field(&self) -> usize {
        size_of::<i64>()
    }

    fn decompress_first(&mut self, input: &mut R, field: &mut [u8]) -> io::Result<()> {
        let mut time = [0; size_of::<i64>()];
        input.read_exact(&mut time)?;
        self.sequences[0].time = i64::from_le_bytes(time);
        field.copy_from_slice(&time);
        Ok(())
    }

    fn decompress_with(
        &mut self,
        decoder: &mut ArithmeticDecoder<R>,
        field: &mut [u8],
    ) -> io::Result<()> {
        // A time is preceded by at most one change.
        if !self.step(decoder)? && !self.step(decoder)? {
            return Err(io::Error::other("its GPS times change the sequence twice"));
        }
        field.copy_from_slice(&self.sequences[self.current].time.to_le_bytes());
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use laz::encoders::ArithmeticEncoder;
    use laz::las::v2::GpsTimeCompressor;
    use laz::record::{
        RecordCompressor, RecordDecompressor, SequentialPointRecordCompressor,
        SequentialPointRecordDecompressor,
    };
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    fn decoder(bytes: &[u8]) -> SequentialPointRecordDecompressor<'_, Cursor<&[u8]>> {
        let mut decoder = SequentialPointRecordDecompressor::new(Cursor::new(bytes));
        decoder.add_field_decompressor(GpsTimes::new());
        decoder
    }

    /// The differences make every symbol occur.
    #[test]
    fn compressed_times_are_restored() {
        let mut draws = ChaCha8Rng::seed_from_u64(0);
        let mut encoder = SequentialPointRecordCompressor::new(Cursor::new(Vec::new()));
        encoder.add_field_compressor(GpsTimeCompressor::default());
        let (mut time, mut difference) = (1_i64 << 40, 1000_i64);
        let times: Vec<[u8; 8]> = (0..20_000)
            .map(|_| {
                let factor: i64 = match draws.random_range(0..8) {
                    0 => 0,
                    1 => draws.random_range(2..600),
                    2 => draws.random_range(-15..0),
                    _ => 1,
                };
                match draws.random_range(0..100) {
                    0 => difference = draws.random_range(-2000..2000),
                    1 => time = draws.random(),
                    2 => time ^= 1 << 50,
                    3 => time ^= 1 << 51,
                    _ => {}
                }
                time = time.wrapping_add(factor * difference + draws.random_range(0..2));
                time.to_le_bytes()
            })
            .collect();
        for time in &times {
            encoder.compress_next(time).unwrap();
        }
        encoder.done().unwrap();
        let bytes = encoder.into_inner().into_inner();
        let mut decoder = decoder(&bytes);
        for expected in &times {
            let mut time = [0; 8];
            decoder.decompress_next(&mut time).unwrap();
            assert_eq!(time, *expected);
        }
    }

    #[test]
    fn endless_changes_of_the_sequence_are_refused() {
        let mut encoder = ArithmeticEncoder::new(Cursor::new(vec![0; 8]));
        encoder.get_mut().set_position(8);
        let mut symbols = ArithmeticModelBuilder::new(SYMBOLS[0]).with_compression(true).build();
        for _ in 0..1_000_000 {
            encoder.encode_symbol(&mut symbols, 3).unwrap();
        }
        encoder.done().unwrap();
        let bytes = encoder.into_inner().into_inner();
        assert!(bytes.len() < 100);
        let mut decoder = decoder(&bytes);
        decoder.decompress_next(&mut [0; 8]).unwrap();
        assert!(decoder.decompress_next(&mut [0; 8]).unwrap_err().to_string().contains("twice"));
    }
}
