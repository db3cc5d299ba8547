//! Drops view-dependent colour with no visible effect.

use densify_core::gaussians::{Gaussians, sh_coefficients, sigmoid};

/// Largest change of a Gaussian's colour from any direction, times its opacity: half a step of an 8-bit channel.
const TOLERANCE: f32 = 0.5 / 255.0;

/// Reduces the model to at most this degree, and sets the highest bands of each Gaussian to zero as long as they change
/// its colour by no more than [`TOLERANCE`]. Formats with entropy coding store zeros in fewer bytes.
pub(super) fn reduce(model: Gaussians, degree: u8) -> Gaussians {
    let mut model = if degree < model.sh_degree { model.with_degree(degree) } else { model };
    let stride = 3 * sh_coefficients(model.sh_degree);
    let rows = model.sh.chunks_exact_mut(stride).zip(&model.opacity_logits);
    for (row, &logit) in rows {
        let mut tolerance = TOLERANCE / sigmoid(logit);
        for band in (1..=model.sh_degree).rev() {
            let (from, to) = (3 * sh_coefficients(band - 1), 3 * sh_coefficients(band));
            tolerance -= max_contribution(band, &row[from..to]);
            if tolerance < 0.0 {
                break;
            }
            row[from..to].fill(0.0);
        }
    }
    model
}

/// Upper bound of a band's contribution to any channel from any direction. By the Cauchy–Schwarz inequality it is the
/// norm of the coefficients times that of the basis functions, whose squares sum to (2l + 1)/4π in every direction
/// (addition theorem).
fn max_contribution(band: u8, coefficients: &[f32]) -> f32 {
    let basis = (f32::from(2 * band + 1) / (4.0 * std::f32::consts::PI)).sqrt();
    let norm = |channel: usize| {
        coefficients.iter().skip(channel).step_by(3).map(|v| v * v).sum::<f32>().sqrt()
    };
    basis * [0, 1, 2].map(norm).into_iter().fold(0.0, f32::max)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_invisible_bands_are_dropped() {
        let mut model = Gaussians::zeros(3, 2);
        // Opaque, faint, and faint with a visible first band.
        model.opacity_logits = vec![9.0, -4.0, -4.0];
        let stride = 3 * sh_coefficients(2);
        for (row, sh) in model.sh.chunks_exact_mut(stride).enumerate() {
            sh[0] = 1.0;
            sh[3] = if row == 2 { 1.0 } else { 0.01 };
            sh[12] = 0.01;
        }
        let small = reduce(model.clone(), 2);
        let bands = |row: usize| {
            let sh = small.sh_of(row);
            [sh[0] != 0.0, sh[3] != 0.0, sh[12] != 0.0]
        };
        // 0.01·√(5/4π) is 0.0063; times the opacity of 0.018, that is 0.03 of an 8-bit step.
        assert_eq!(bands(0), [true, true, true]);
        assert_eq!(bands(1), [true, false, false]);
        assert_eq!(bands(2), [true, true, false]);
        assert_eq!(reduce(model, 0).sh, [1.0, 0.0, 0.0].repeat(3));
    }

    #[test]
    fn the_bound_holds_in_every_direction() {
        let coefficients = [0.3, -0.1, 0.2, 0.5, 0.4, -0.3, -0.2, 0.1, 0.6];
        let bound = max_contribution(1, &coefficients);
        let mut largest = 0.0_f32;
        for step in 0..1_000 {
            let (turn, height) = (step as f32 * 2.4, step as f32 / 500.0 - 1.0);
            let flat = (1.0 - height * height).sqrt();
            let d = [flat * turn.cos(), flat * turn.sin(), height];
            for channel in 0..3 {
                let c = |k: usize| coefficients[3 * k + channel];
                let value = 0.488_602_5 * (-d[1] * c(0) + d[2] * c(1) - d[0] * c(2));
                largest = largest.max(value.abs());
            }
        }
        assert!(largest <= bound && largest > 0.98 * bound, "{largest} {bound}");
    }
}
