//! Morton codes (Morton 1966): positions on a Z-order curve through space, by which the initial rows are sorted.
//!
//! Neighbours in memory are then neighbours in the scene: of rows that are processed together, mostly all or none are
//! visible, and the rows in a tile of the image share cache lines.

/// Bits per axis.
const BITS: u32 = 10;

/// The Morton code of a point. Coordinates are compressed to (−1, 1), so that no bounds are needed and outliers
/// do no harm. The scene's extent should be about 1.
pub fn morton_code(point: [f64; 3]) -> u32 {
    let [x, y, z] = point.map(|x| {
        let squeezed = x / (1.0 + x.abs());
        // The cast turns a non-finite number into 0.
        spread_bits(((0.5 * squeezed + 0.5) * f64::from(1 << BITS)) as u32)
    });
    x | y << 1 | z << 2
}

/// Inserts two zeros between neighbouring bits of a number. Numbers of more than [`BITS`] bits are clamped.
fn spread_bits(x: u32) -> u32 {
    let x = x.min((1 << BITS) - 1);
    let x = (x | x << 16) & 0x0300_00ff;
    let x = (x | x << 8) & 0x0300_f00f;
    let x = (x | x << 4) & 0x030c_30c3;
    (x | x << 2) & 0x0924_9249
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codes_interleave_the_bits_of_coordinates() {
        for x in [0, 1, 2, 5, 0b10_1101_0011, (1 << BITS) - 1] {
            let bits: u32 = (0..BITS).map(|i| (x >> i & 1) << (3 * i)).sum();
            assert_eq!(spread_bits(x), bits, "{x:#b}");
        }
        assert_eq!(spread_bits(1 << BITS), spread_bits((1 << BITS) - 1));
        assert_eq!(morton_code([0.1, 0.2, 0.3]), morton_code([0.1001, 0.2001, 0.3001]));
        assert!(
            morton_code([-2.0; 3]) < morton_code([-1.0; 3])
                && morton_code([1.0; 3]) < morton_code([f64::MAX; 3])
        );
        assert_eq!(morton_code([f64::NAN; 3]), 0);
    }
}
