//! Splines through equally spaced values.

/// Weights of four consecutive values that interpolate between the second (`t` = 0) and the third (`t` = 1) of them
/// (Catmull and Rom 1974).
pub fn catmull_rom(t: f64) -> [f64; 4] {
    let (t2, t3) = (t * t, t * t * t);
    [
        0.5 * (2.0 * t2 - t - t3),
        0.5 * (3.0 * t3 - 5.0 * t2 + 2.0),
        0.5 * (4.0 * t2 + t - 3.0 * t3),
        0.5 * (t3 - t2),
    ]
}
