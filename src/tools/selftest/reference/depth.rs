//! Depth in the loss, and its derivatives with respect to the blend weights and depths along each ray, straight from
//! the definitions of [`DepthTerm`] and [`StepInput::distortion`](densify_render::StepInput).

use densify_core::image::depth::DepthMap;
use densify_render::DepthTerm;

/// Depth in the loss of a step.
#[derive(Debug, Clone)]
pub struct DepthLoss {
    /// Inverse depth `[1/scene unit]` and confidence times mask of each pixel; the latter is 0 where no depth is given.
    pub given: Vec<[f64; 2]>,
    /// Mask of each pixel, in `[0, 1]`.
    pub mask: Vec<f64>,
    /// Median of the given depth `[scene units]`.
    pub median: f64,
    /// The term of the pixels with given depth, and its weight.
    pub term: DepthTerm,
    /// See `term`.
    pub weight: f64,
    /// Weight of the distortion term of the other pixels.
    pub distortion: f64,
}

/// The samples of a ray: weight and depth of each.
pub type Ray = Vec<[f64; 2]>;

/// Sum of the weights, and expected inverse depth.
fn expected(ray: &[[f64; 2]]) -> [f64; 2] {
    let alpha: f64 = ray.iter().map(|[w, _]| w).sum();
    [alpha, ray.iter().map(|[w, z]| w / z).sum::<f64>() / alpha]
}

impl DepthLoss {
    /// Depth in the loss for a map and a mask.
    pub fn new(
        map: Option<&DepthMap>,
        mask: Option<&[u8]>,
        pixels: usize,
        (term, weight): (DepthTerm, f64),
        distortion: f64,
    ) -> Self {
        let mask: Vec<f64> =
            (0..pixels).map(|p| mask.map_or(1.0, |mask| f64::from(mask[p]) / 255.0)).collect();
        let known = |p: usize| {
            map.map_or([0.0; 2], |map| {
                let inverse = f64::from(map.inverse[p]) * f64::from(map.unit);
                let confidence = f64::from(map.confidence[p]) / 255.0 * mask[p];
                [inverse, if map.inverse[p] == 0 { 0.0 } else { confidence }]
            })
        };
        let given = (0..pixels).map(known).collect();
        let median = map.map_or(0.0, |map| f64::from(map.median));
        Self { given, mask, median, term, weight, distortion }
    }

    /// Sum of all confidences.
    fn total(&self) -> f64 {
        self.given.iter().map(|[_, confidence]| confidence).sum()
    }

    /// The term of one pixel with given depth, without its weight and confidence.
    fn term_of(&self, inverse: f64, ray: &[[f64; 2]]) -> f64 {
        match self.term {
            DepthTerm::Expected if ray.is_empty() => 0.0,
            DepthTerm::Expected => self.median * (expected(ray)[1] - inverse).abs(),
            DepthTerm::Samples => {
                let each = |[w, z]: &[f64; 2]| w * (self.median * (1.0 / z - inverse).abs() - 1.0);
                1.0 + ray.iter().map(each).sum::<f64>()
            }
        }
    }

    /// The term of the pixels with given depth, without its weight.
    pub fn term_value(&self, rays: &[Ray]) -> f64 {
        let pixels = self.given.iter().zip(rays).filter(|([_, confidence], _)| *confidence > 0.0);
        let sum: f64 =
            pixels.map(|(&[x, confidence], ray)| confidence * self.term_of(x, ray)).sum();
        if sum == 0.0 { 0.0 } else { sum / self.total() }
    }

    /// The whole loss. The scale of the distortion is that of `frozen`, because its gradient holds the scale fixed.
    pub fn value(&self, rays: &[Ray], frozen: &[Ray]) -> f64 {
        let mut distortion = 0.0;
        for (p, (ray, frozen)) in rays.iter().zip(frozen).enumerate() {
            if self.given[p][1] > 0.0 || ray.is_empty() {
                continue;
            }
            let ([_, x], [_, scale]) = (expected(ray), expected(frozen));
            let squares = ray.iter().map(|[w, z]| w * ((1.0 / z - x) / scale).powi(2));
            distortion += self.mask[p] * squares.sum::<f64>();
        }
        self.weight * self.term_value(rays) + self.distortion * distortion / rays.len() as f64
    }

    /// Derivatives of the loss with respect to weight and depth of each sample.
    pub fn gradient(&self, rays: &[Ray]) -> Vec<Vec<[f64; 2]>> {
        let total = self.total();
        let of_ray = |(p, ray): (usize, &Ray)| {
            let [inverse, confidence] = self.given[p];
            let [alpha, mean] = expected(ray);
            let of_sample = |&[w, z]: &[f64; 2]| {
                let x = 1.0 / z;
                // By the weight, and by the inverse depth.
                let [by_weight, by_inverse] = if confidence == 0.0 {
                    let factor = self.distortion * self.mask[p] / rays.len() as f64 / (mean * mean);
                    [factor * (x - mean).powi(2), factor * 2.0 * w * (x - mean)]
                } else {
                    let factor = self.weight * confidence / total;
                    match self.term {
                        DepthTerm::Expected => {
                            let slope = factor * self.median * (mean - inverse).signum() / alpha;
                            [slope * (x - mean), slope * w]
                        }
                        DepthTerm::Samples => {
                            let distance = self.median * (x - inverse);
                            let slope = self.median * distance.signum();
                            [factor * (distance.abs() - 1.0), factor * w * slope]
                        }
                    }
                };
                [by_weight, -by_inverse * x * x]
            };
            ray.iter().map(of_sample).collect()
        };
        rays.iter().enumerate().map(of_ray).collect()
    }
}
