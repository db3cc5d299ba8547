//! Places on a Z-curve through space (Morton 1966), in whose order the first rows stand.
//!
//! Rows that are near each other in memory are then near each other in the scene: those of a block are
//! mostly seen together or not at all, and those of a tile share cache lines.

/// Bits per axis.
const BITS: u32 = 10;

/// Where on the curve a point lies. Coordinates are squeezed into (−1, 1), so that no bounds are needed
/// and outliers spoil nothing; the scene's extent is about 1.
pub fn place(point: [f64; 3]) -> u32 {
    let [x, y, z] = point.map(|x| {
        let squeezed = x / (1.0 + x.abs());
        // What is not finite is 0.
        spread(((0.5 * squeezed + 0.5) * f64::from(1 << BITS)) as u32)
    });
    x | y << 1 | z << 2
}

/// Two zeros between the bits of a number below 2^[`BITS`].
fn spread(x: u32) -> u32 {
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
    fn bits_of_three_numbers_alternate() {
        for x in [0, 1, 2, 5, 0b10_1101_0011, (1 << BITS) - 1] {
            let bits: u32 = (0..BITS).map(|i| (x >> i & 1) << (3 * i)).sum();
            assert_eq!(spread(x), bits, "{x:#b}");
        }
        assert_eq!(spread(1 << BITS), spread((1 << BITS) - 1));
        assert_eq!(place([0.1, 0.2, 0.3]), place([0.1001, 0.2001, 0.3001]));
        assert!(place([-2.0; 3]) < place([-1.0; 3]) && place([1.0; 3]) < place([f64::MAX; 3]));
        assert_eq!(place([f64::NAN; 3]), 0);
    }
}
