//! The reference: a dense, slow renderer in `f64` with analytic gradients.
//!
//! It follows the textbook (Zwicker et al., *EWA Splatting*, IEEE TVCG 8(3), 2002; Kerbl et al.,
//! *3D Gaussian Splatting*, ACM TOG 42(4), 2023): every pixel visits every row, covariance and conic are plain
//! matrices, and the spherical harmonics are a table of monomials. The backends do none of that, so that they
//! and the reference do not share errors. Antialiasing follows Mip-Splatting (Yu et al., CVPR 2024, equation 9).
//! `tests/it/central.rs` checks the gradients by central differences, `tests/it/oracle/` compares with stored arrays.

pub mod blend;
pub mod depth;
pub mod loss;
pub mod project;

use densify_core::antialiasing::Antialiasing;
use densify_core::camera::Camera;
use densify_core::gaussians::{Gaussians, sh_coefficients};

/// The constants in which renderers differ.
#[derive(Debug, Clone, Copy)]
pub struct Rules {
    /// Near plane `[scene units]`: rows at smaller camera z are not rendered.
    pub near: f64,
    /// Smaller alphas are skipped.
    pub alpha_min: f64,
    /// Larger alphas are clamped, and have no gradient.
    pub alpha_max: f64,
    /// A row that would lower the transmittance to this ends the pixel and is not blended.
    pub transmittance_min: f64,
}

/// In the Jacobian of the projection, centres are clamped to the image enlarged by this factor about its own
/// centre.
const FRUSTUM_MARGIN: f64 = 1.3;

impl Rules {
    /// The rules of the renderer.
    pub const STANDARD: Self =
        Self { near: 0.01, alpha_min: 1.0 / 255.0, alpha_max: 0.99, transmittance_min: 1e-4 };
    /// The rules without the two thresholds that make a rendering discontinuous in its parameters, so that
    /// finite differences approximate derivatives.
    pub const SMOOTH: Self =
        Self { alpha_min: 0.0, transmittance_min: f64::NEG_INFINITY, ..Self::STANDARD };
}

/// A model in `f64`, or a gradient with respect to one. Fields as in [`Gaussians`].
#[derive(Debug, Clone, Default)]
pub struct Model {
    /// Coefficients of spherical harmonics per row and channel.
    pub coefficients: usize,
    /// Antialiasing; unused in a gradient.
    pub antialiasing: Antialiasing,
    /// Shape: `[rows]`.
    pub means: Vec<[f64; 3]>,
    /// Shape: `[rows]`.
    pub log_scales: Vec<[f64; 3]>,
    /// (w, x, y, z) of any length. Shape: `[rows]`.
    pub quats: Vec<[f64; 4]>,
    /// Shape: `[rows]`.
    pub opacity_logits: Vec<f64>,
    /// Shape: [rows, coefficients, 3].
    pub sh: Vec<f64>,
}

/// Names of the parameter classes; the stored arrays of the oracle have the same names.
pub const CLASSES: [&str; 5] = ["means", "log_scales", "quats", "opacity_logits", "sh"];

impl From<&Gaussians> for Model {
    fn from(gaussians: &Gaussians) -> Self {
        Self {
            coefficients: sh_coefficients(gaussians.sh_degree),
            antialiasing: gaussians.antialiasing,
            means: gaussians.means.iter().map(|v| v.map(f64::from)).collect(),
            log_scales: gaussians.log_scales.iter().map(|v| v.map(f64::from)).collect(),
            quats: gaussians.quats.iter().map(|v| v.map(f64::from)).collect(),
            opacity_logits: gaussians.opacity_logits.iter().copied().map(f64::from).collect(),
            sh: gaussians.sh.iter().copied().map(f64::from).collect(),
        }
    }
}

impl Model {
    /// Variance added to the diagonal of a projected covariance `[px²]`.
    fn blur(&self) -> f64 {
        match self.antialiasing {
            Antialiasing::None | Antialiasing::Wide => 0.3,
            Antialiasing::Narrow => 0.1,
        }
    }

    /// A gradient of zeros.
    pub fn zeros(rows: usize, coefficients: usize) -> Self {
        Self {
            coefficients,
            antialiasing: Antialiasing::None,
            means: vec![[0.0; 3]; rows],
            log_scales: vec![[0.0; 3]; rows],
            quats: vec![[0.0; 4]; rows],
            opacity_logits: vec![0.0; rows],
            sh: vec![0.0; rows * coefficients * 3],
        }
    }

    /// Number of rows.
    pub fn rows(&self) -> usize {
        self.means.len()
    }

    /// All values of the parameter class `name`, row after row.
    ///
    /// # Panics
    /// When `name` is not in [`CLASSES`].
    pub fn class(&self, name: &str) -> &[f64] {
        match name {
            "means" => self.means.as_flattened(),
            "log_scales" => self.log_scales.as_flattened(),
            "quats" => self.quats.as_flattened(),
            "opacity_logits" => &self.opacity_logits,
            "sh" => &self.sh,
            _ => panic!("no parameter class is called {name}"),
        }
    }

    /// All values of the parameter class `name`, mutable.
    ///
    /// # Panics
    /// When `name` is not in [`CLASSES`].
    pub fn class_mut(&mut self, name: &str) -> &mut [f64] {
        match name {
            "means" => self.means.as_flattened_mut(),
            "log_scales" => self.log_scales.as_flattened_mut(),
            "quats" => self.quats.as_flattened_mut(),
            "opacity_logits" => &mut self.opacity_logits,
            "sh" => &mut self.sh,
            _ => panic!("no parameter class is called {name}"),
        }
    }

    /// Adds another gradient of the same shape.
    pub fn add(&mut self, other: &Self) {
        for class in CLASSES {
            for (sum, value) in self.class_mut(class).iter_mut().zip(other.class(class)) {
                *sum += value;
            }
        }
    }
}

/// A view to render: camera, background and SH degree.
#[derive(Debug, Clone, Copy)]
pub struct View<'a> {
    /// Camera to render from.
    pub camera: &'a Camera,
    /// Background colour.
    pub background: [f64; 3],
    /// SH degree to evaluate, <= the model's.
    pub sh_degree: u8,
}

/// dL/d(image).
#[derive(Debug, Clone)]
pub struct Upstream {
    /// Shape: [height, width, 3].
    pub rgb: Vec<f64>,
    /// Shape: [height, width].
    pub alpha: Vec<f64>,
    /// Shape: [height, width].
    pub depth: Vec<f64>,
}

impl Upstream {
    /// Zeros the gradient where a threshold is close, so that gradients can be compared tightly everywhere.
    #[must_use]
    pub fn ignoring(mut self, boundary: &[bool]) -> Self {
        for (p, _) in boundary.iter().enumerate().filter(|(_, close)| **close) {
            self.rgb[3 * p..3 * p + 3].fill(0.0);
            self.alpha[p] = 0.0;
            self.depth[p] = 0.0;
        }
        self
    }
}

/// A rendering, with details for tests.
#[derive(Debug, Clone)]
pub struct Image {
    /// Background included, not clamped. Shape: [height, width, 3].
    pub rgb: Vec<f64>,
    /// 1 − final transmittance.
    pub alpha: Vec<f64>,
    /// Σ α·T·z.
    pub depth: Vec<f64>,
    /// Transmittance left for the background.
    pub transmittance: Vec<f64>,
    /// Number of rows blended into each pixel.
    pub blended: Vec<u32>,
    /// Pixels in which a threshold is so close that `f32` may decide differently.
    pub boundary: Vec<bool>,
}

impl Image {
    /// Σ image · upstream.
    pub fn dot(&self, upstream: &Upstream) -> f64 {
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        dot(&self.rgb, &upstream.rgb)
            + dot(&self.alpha, &upstream.alpha)
            + dot(&self.depth, &upstream.depth)
    }
}

/// Gradients and row statistics of a view.
#[derive(Debug, Clone)]
pub struct Gradient {
    /// Gradient of the parameters.
    pub model: Model,
    /// Gradient of the projected rows. Shape: `[rows]`.
    pub screen: Vec<ScreenGradient>,
}

/// Gradient and statistics of one projected row.
#[derive(Debug, Clone, Copy, Default)]
pub struct ScreenGradient {
    /// dL/d(projected mean) [1/px].
    pub mean: [f64; 2],
    /// Σ over pixels of the absolute values of dL/d(projected mean).
    pub mean_abs: [f64; 2],
    /// dL/d(A, B, C), the conic of exp(−½(A·dx² + C·dy²) − B·dx·dy).
    pub conic: [f64; 3],
    /// dL/d(colour after the clamp at 0).
    pub colour: [f64; 3],
    /// dL/d(opacity as blended).
    pub opacity: f64,
    /// dL/d(camera z) through the depth image only.
    pub depth: f64,
    /// Largest alpha·T.
    pub max_weight: f64,
    /// Sum of alpha·T.
    pub sum_weight: f64,
    /// Number of pixels that the row is blended into.
    pub pixels: u32,
}

/// Renders a view.
pub fn render(model: &Model, view: View<'_>, rules: &Rules) -> Image {
    let splats = project::project(model, view, rules);
    blend::render(&splats, &project::by_depth(&splats), view, rules)
}

/// Renders a view and differentiates Σ image · upstream.
pub fn differentiate(
    model: &Model,
    view: View<'_>,
    rules: &Rules,
    upstream: &Upstream,
) -> (Image, Gradient) {
    let splats = project::project(model, view, rules);
    let order = project::by_depth(&splats);
    let image = blend::render(&splats, &order, view, rules);
    let screen = blend::backward(&splats, &order, view, rules, upstream);
    let model = project::backward(model, view, &splats, &screen);
    (image, Gradient { model, screen })
}
