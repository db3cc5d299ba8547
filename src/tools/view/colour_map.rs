//! The colour map for numbers. It runs from dark to light, so that it is readable without colour vision.

/// Equally spaced stops, sRGB.
pub(super) const STOPS: [[u8; 3]; 6] =
    [[22, 18, 56], [54, 52, 140], [34, 116, 170], [40, 168, 140], [150, 210, 90], [255, 244, 170]];

/// The colour of a number in `[0, 1]`. Numbers outside are clamped; NaN counts as 0.
pub(super) fn colour(value: f32) -> [f32; 3] {
    let place = value.clamp(0.0, 1.0).max(0.0) * (STOPS.len() - 1) as f32;
    let first = (place as usize).min(STOPS.len() - 2);
    let t = place - first as f32;
    std::array::from_fn(|channel| {
        let [a, b] = [STOPS[first], STOPS[first + 1]].map(|stop| f32::from(stop[channel]) / 255.0);
        a + (b - a) * t
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn larger_numbers_are_lighter() {
        let luminance = |value: f32| {
            let [r, g, b] = colour(value);
            0.2126 * r + 0.7152 * g + 0.0722 * b
        };
        let along: Vec<f32> = (0..=100_u8).map(|i| luminance(f32::from(i) / 100.0)).collect();
        assert!(along.is_sorted_by(|a, b| a < b), "{along:?}");
        for (value, same) in [(-3.0, 0.0), (f32::NAN, 0.0), (9.0, 1.0), (f32::INFINITY, 1.0)] {
            assert_eq!(colour(value).map(f32::to_bits), colour(same).map(f32::to_bits), "{value}");
        }
    }
}
