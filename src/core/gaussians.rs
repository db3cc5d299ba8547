//! Gaussians on the host: the parametrisation, stated once.
//!
//! A row is one Gaussian: mean, log of the standard deviation per axis, orientation as a
//! quaternion (w, x, y, z; need not be normalised), opacity as a logit, and spherical-harmonic
//! coefficients of its colour: colour = max(0, ½ + Σ Y_k(direction)·sh_k).

/// Number of spherical-harmonic coefficients per channel at `degree`: (degree + 1)².
#[must_use]
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
    /// All of them, in the order in which a row has its parameters.
    pub const ALL: [Self; 5] =
        [Self::Means, Self::LogScales, Self::Quats, Self::OpacityLogits, Self::Sh];

    /// Where a row of a model of this degree has the array's numbers, of all its parameters.
    #[must_use]
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

/// A model: structure of arrays, one entry per row in each.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Gaussians {
    /// Spherical-harmonic degree, 0..=3; decides the length of `sh`.
    pub sh_degree: u8,
    /// Means `[scene units]`. Shape: `[rows]`.
    pub means: Vec<[f32; 3]>,
    /// Natural logarithm of the standard deviations `[ln scene units]`. Shape: `[rows]`.
    pub log_scales: Vec<[f32; 3]>,
    /// Orientations (w, x, y, z). Shape: `[rows]`.
    pub quats: Vec<[f32; 4]>,
    /// Opacity logits; opacity = 1 / (1 + exp(−logit)). Shape: `[rows]`.
    pub opacity_logits: Vec<f32>,
    /// Coefficient-major, RGB last. Shape: `[rows, (degree + 1)², 3]`.
    pub sh: Vec<f32>,
}

impl Gaussians {
    /// A model of this degree from its arrays, each row after row.
    pub fn from_arrays<E>(
        sh_degree: u8,
        mut array: impl FnMut(ModelArray) -> Result<Vec<f32>, E>,
    ) -> Result<Self, E> {
        Ok(Self {
            sh_degree,
            means: in_rows(array(ModelArray::Means)?),
            log_scales: in_rows(array(ModelArray::LogScales)?),
            quats: in_rows(array(ModelArray::Quats)?),
            opacity_logits: array(ModelArray::OpacityLogits)?,
            sh: array(ModelArray::Sh)?,
        })
    }

    /// So many rows of zeros.
    #[must_use]
    pub fn zeros(rows: usize, sh_degree: u8) -> Self {
        Self {
            sh_degree,
            means: vec![[0.0; 3]; rows],
            log_scales: vec![[0.0; 3]; rows],
            quats: vec![[0.0; 4]; rows],
            opacity_logits: vec![0.0; rows],
            sh: vec![0.0; rows * 3 * sh_coefficients(sh_degree)],
        }
    }

    /// The same model with another degree: higher bands are dropped, new ones are zero.
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

    /// Appends the rows of another model of the same degree.
    ///
    /// # Panics
    /// When the degrees differ.
    pub fn append(&mut self, mut other: Self) {
        assert_eq!(self.sh_degree, other.sh_degree, "degrees of models that are joined");
        self.means.append(&mut other.means);
        self.log_scales.append(&mut other.log_scales);
        self.quats.append(&mut other.quats);
        self.opacity_logits.append(&mut other.opacity_logits);
        self.sh.append(&mut other.sh);
    }

    /// These rows, in this order.
    ///
    /// # Panics
    /// When there is no such row.
    #[must_use]
    pub fn gather(&self, rows: &[usize]) -> Self {
        Self {
            sh_degree: self.sh_degree,
            means: rows.iter().map(|&row| self.means[row]).collect(),
            log_scales: rows.iter().map(|&row| self.log_scales[row]).collect(),
            quats: rows.iter().map(|&row| self.quats[row]).collect(),
            opacity_logits: rows.iter().map(|&row| self.opacity_logits[row]).collect(),
            sh: rows.iter().flat_map(|&row| self.sh_of(row)).copied().collect(),
        }
    }

    /// Number of rows.
    #[must_use]
    pub fn len(&self) -> usize {
        self.means.len()
    }

    /// Whether there is no row.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }

    /// The coefficients of one row. Shape: `[(degree + 1)², 3]`.
    #[must_use]
    pub fn sh_of(&self, row: usize) -> &[f32] {
        let n = 3 * sh_coefficients(self.sh_degree);
        &self.sh[row * n..(row + 1) * n]
    }
}

/// The same numbers, N to a row; where they are, if that can be.
fn in_rows<const N: usize>(values: Vec<f32>) -> Vec<[f32; N]> {
    bytemuck::try_cast_vec(values).unwrap_or_else(|(_, values)| values.as_chunks().0.to_vec())
}

/// Opacity of a logit: 1 / (1 + exp(−x)), without overflow at either end.
#[must_use]
pub fn sigmoid(x: f32) -> f32 {
    let e = (-x.abs()).exp();
    if x >= 0.0 { 1.0 / (1.0 + e) } else { e / (1.0 + e) }
}

/// Logit of an opacity in (0, 1): ln(o / (1 − o)).
#[must_use]
pub fn logit(opacity: f32) -> f32 {
    opacity.ln() - (-opacity).ln_1p()
}

/// Band-0 coefficient of a colour seen the same from everywhere: (c − ½)/Y₀.
#[must_use]
pub fn rgb_to_dc(colour: f32) -> f32 {
    (colour - 0.5) / crate::sh::C0
}

/// The colour that a band-0 coefficient alone shows, not clamped: ½ + Y₀·c.
#[must_use]
pub fn dc_to_rgb(coefficient: f32) -> f32 {
    0.5 + crate::sh::C0 * coefficient
}
