//! Gaussians on the host, and their parametrisation.
//!
//! A row is one Gaussian: mean, log of the standard deviation per axis, orientation as a
//! quaternion (w, x, y, z; not necessarily normalised), opacity as a logit, and spherical-harmonic
//! coefficients of its colour: colour = max(0, ½ + Σ Y_k(direction)·sh_k).

use crate::antialiasing::Antialiasing;

/// Number of spherical-harmonic coefficients per channel at `degree`: (degree + 1)².
pub const fn sh_coefficients(degree: u8) -> usize {
    (degree as usize + 1) * (degree as usize + 1)
}

/// Highest spherical-harmonic degree.
pub const MAX_SH_DEGREE: u8 = 3;

/// One of the arrays of a model.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ModelArray {
    /// See [`Gaussians::means`].
    Means,
    /// See [`Gaussians::log_scales`].
    LogScales,
    /// See [`Gaussians::quats`].
    Quats,
    /// See [`Gaussians::opacity_logits`].
    OpacityLogits,
    /// See [`Gaussians::sh`].
    Sh,
}

impl ModelArray {
    /// All arrays, in the order of a row's parameters.
    pub const ALL: [Self; 5] =
        [Self::Means, Self::LogScales, Self::Quats, Self::OpacityLogits, Self::Sh];

    /// The array that holds the parameter with this index in a row.
    pub fn of_parameter(index: usize) -> Self {
        let holds = |array: &Self| array.parameters(MAX_SH_DEGREE).contains(&index);
        Self::ALL.into_iter().find(holds).unwrap_or(Self::Sh)
    }

    /// The indices of the array's values among a row's parameters at a spherical-harmonic degree.
    pub const fn parameters(self, sh_degree: u8) -> std::ops::Range<usize> {
        match self {
            Self::Means => 0..3,
            Self::LogScales => 3..6,
            Self::Quats => 6..10,
            Self::OpacityLogits => 10..11,
            Self::Sh => 11..11 + 3 * sh_coefficients(sh_degree),
        }
    }
}

/// A model as a structure of arrays, each with one entry per row.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Gaussians {
    /// Spherical-harmonic degree, 0..=3; decides the length of `sh`.
    pub sh_degree: u8,
    /// How the model is rendered where its Gaussians are smaller than a pixel.
    pub antialiasing: Antialiasing,
    /// The point from which means are measured `[scene units]`: a position is a mean plus `origin`. It
    /// is 0 during training; elsewhere it may be nonzero, for scenes whose coordinates would be too coarse in f32.
    pub origin: [f64; 3],
    /// Means, relative to `origin` `[scene units]`. Shape: `[rows]`.
    pub means: Vec<[f32; 3]>,
    /// Natural logarithm of the standard deviations `[ln scene units]`. Shape: `[rows]`.
    pub log_scales: Vec<[f32; 3]>,
    /// Orientations (w, x, y, z). Shape: `[rows]`.
    pub quats: Vec<[f32; 4]>,
    /// Opacity logits; opacity = 1 / (1 + exp(−logit)). Shape: `[rows]`.
    pub opacity_logits: Vec<f32>,
    /// Spherical-harmonic coefficients, RGB last. Shape: `[rows, (degree + 1)², 3]`.
    pub sh: Vec<f32>,
}

impl Gaussians {
    /// Builds a model without antialiasing from its arrays, each row-major.
    ///
    /// # Errors
    /// The first error that `array` returns.
    pub fn from_arrays<E>(
        sh_degree: u8,
        mut array: impl FnMut(ModelArray) -> Result<Vec<f32>, E>,
    ) -> Result<Self, E> {
        Ok(Self {
            sh_degree,
            origin: [0.0; 3],
            antialiasing: Antialiasing::None,
            means: in_rows(array(ModelArray::Means)?),
            log_scales: in_rows(array(ModelArray::LogScales)?),
            quats: in_rows(array(ModelArray::Quats)?),
            opacity_logits: array(ModelArray::OpacityLogits)?,
            sh: array(ModelArray::Sh)?,
        })
    }

    /// A model whose parameters are all 0.
    pub fn zeros(rows: usize, sh_degree: u8) -> Self {
        Self {
            sh_degree,
            origin: [0.0; 3],
            antialiasing: Antialiasing::None,
            means: vec![[0.0; 3]; rows],
            log_scales: vec![[0.0; 3]; rows],
            quats: vec![[0.0; 4]; rows],
            opacity_logits: vec![0.0; rows],
            sh: vec![0.0; rows * 3 * sh_coefficients(sh_degree)],
        }
    }

    /// The position of a row.
    ///
    /// # Panics
    /// When the row does not exist.
    pub fn position(&self, row: usize) -> [f64; 3] {
        std::array::from_fn(|axis| {
            let mean = f64::from(self.means[row][axis]);
            // Adding 0 would change the sign of −0.
            if self.origin[axis] == 0.0 { mean } else { mean + self.origin[axis] }
        })
    }

    /// True if means are measured from a point other than 0.
    pub fn is_local(&self) -> bool {
        self.origin.iter().any(|&axis| axis != 0.0)
    }

    /// True if means are measured from this point.
    pub fn has_origin(&self, origin: [f64; 3]) -> bool {
        self.origin.map(f64::to_bits) == origin.map(f64::to_bits)
    }

    /// The same positions, measured from another point. They are rounded to f32 unless the point is the same.
    #[must_use]
    pub fn with_origin(mut self, origin: [f64; 3]) -> Self {
        if !self.has_origin(origin) {
            for row in 0..self.len() {
                let position = self.position(row);
                self.means[row] =
                    std::array::from_fn(|axis| (position[axis] - origin[axis]) as f32);
            }
            self.origin = origin;
        }
        self
    }

    /// Changes the degree: higher bands are dropped, new ones are zero.
    #[must_use]
    pub fn with_degree(mut self, sh_degree: u8) -> Self {
        if sh_degree != self.sh_degree {
            let [old, new] = [self.sh_degree, sh_degree].map(|degree| 3 * sh_coefficients(degree));
            let mut sh = vec![0.0; self.len() * new];
            for (to, from) in sh.chunks_exact_mut(new).zip(self.sh.chunks_exact(old)) {
                to[..old.min(new)].copy_from_slice(&from[..old.min(new)]);
            }
            (self.sh, self.sh_degree) = (sh, sh_degree);
        }
        self
    }

    /// Appends the rows of another model of the same degree and antialiasing. A model without rows takes the other's
    /// origin.
    ///
    /// # Panics
    /// When the degrees or the antialiasing differ.
    pub fn append(&mut self, mut other: Self) {
        assert_eq!(self.sh_degree, other.sh_degree, "models of different degrees cannot be joined");
        assert_eq!(
            self.antialiasing, other.antialiasing,
            "models with different antialiasing cannot be joined"
        );
        if self.is_empty() {
            self.origin = other.origin;
        }
        other = other.with_origin(self.origin);
        self.means.append(&mut other.means);
        self.log_scales.append(&mut other.log_scales);
        self.quats.append(&mut other.quats);
        self.opacity_logits.append(&mut other.opacity_logits);
        self.sh.append(&mut other.sh);
    }

    /// A model of the given rows, in the given order.
    ///
    /// # Panics
    /// When a row does not exist.
    pub fn gather(&self, rows: &[usize]) -> Self {
        Self {
            sh_degree: self.sh_degree,
            origin: self.origin,
            antialiasing: self.antialiasing,
            means: rows.iter().map(|&row| self.means[row]).collect(),
            log_scales: rows.iter().map(|&row| self.log_scales[row]).collect(),
            quats: rows.iter().map(|&row| self.quats[row]).collect(),
            opacity_logits: rows.iter().map(|&row| self.opacity_logits[row]).collect(),
            sh: rows.iter().flat_map(|&row| self.sh_of(row)).copied().collect(),
        }
    }

    /// Number of rows.
    pub fn len(&self) -> usize {
        self.means.len()
    }

    /// Returns whether the model has no rows.
    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }

    /// The coefficients of one row. Shape: `[(degree + 1)², 3]`.
    pub fn sh_of(&self, row: usize) -> &[f32] {
        let n = 3 * sh_coefficients(self.sh_degree);
        &self.sh[row * n..(row + 1) * n]
    }
}

/// Groups numbers into arrays of `N`, without a copy if the allocation permits.
fn in_rows<const N: usize>(values: Vec<f32>) -> Vec<[f32; N]> {
    bytemuck::try_cast_vec(values).unwrap_or_else(|(_, values)| values.as_chunks().0.to_vec())
}

/// The opacity of a logit: 1 / (1 + exp(−x)), without overflow.
pub fn sigmoid(x: f32) -> f32 {
    let e = (-x.abs()).exp();
    if x >= 0.0 { 1.0 / (1.0 + e) } else { e / (1.0 + e) }
}

/// The logit of an opacity in (0, 1): ln(o / (1 − o)).
pub fn logit(opacity: f32) -> f32 {
    opacity.ln() - (-opacity).ln_1p()
}

/// The band-0 coefficient of a view-independent colour: (c − ½)/Y₀.
pub fn rgb_to_dc(colour: f32) -> f32 {
    (colour - 0.5) / crate::sh::C0
}

/// The view-independent colour of a band-0 coefficient, not clamped: ½ + Y₀·c.
pub fn dc_to_rgb(coefficient: f32) -> f32 {
    0.5 + crate::sh::C0 * coefficient
}
