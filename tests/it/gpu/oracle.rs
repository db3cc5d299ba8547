//! Against the stored float64 arrays: images within 1e-4, gradients within twenty times what
//! float32 arithmetic loses.

use densify::backend::cpu::ImageGradient;

use super::{backend, name, ways};
use crate::oracle::case::{Part, cases};
use crate::subject;
use densify::verify::compare::{Limits, Table, compare_images, relative_error};
use densify::verify::reference::CLASSES;

const GPU: Limits = Limits { interior: 1e-4, ..Limits::CPU };

#[test]
fn the_gpu_reproduces_stored_images_and_gradients() {
    let cases = cases();
    for device in ways() {
        let mut table = Table::new(&format!("{} against stored arrays", name(device)));
        for case in &cases {
            let mut gpu = backend(&case.model, device);
            for part in Part::ALL {
                let mut sums: Vec<Vec<f64>> = Vec::new();
                for (index, camera) in case.cameras.iter().enumerate() {
                    let upstream = case.upstream(index, part);
                    let narrow = |values: &[f64]| values.iter().map(|&v| v as f32).collect();
                    let upstream = ImageGradient {
                        rgb: narrow(&upstream.rgb),
                        alpha: narrow(&upstream.alpha),
                        depth: narrow(&upstream.depth),
                    };
                    let outcome =
                        gpu.differentiate(camera, case.background, case.sh_degree, &upstream);
                    let (image, gradient) = outcome.expect("a small image is rendered");
                    let classes = CLASSES.map(|class| subject::class(&gradient, class).to_vec());
                    if sums.is_empty() {
                        sums = classes.iter().map(|class| vec![0.0; class.len()]).collect();
                    }
                    for (sum, class) in sums.iter_mut().zip(&classes) {
                        sum.iter_mut().zip(class).for_each(|(s, g)| *s += f64::from(*g));
                    }
                    if part == Part::Full {
                        let close: Vec<bool> = case.decided(index).iter().map(|ok| !ok).collect();
                        let rgb = case.of_camera("rgb", index);
                        let outcome = compare_images(&image.rgb, rgb, &close, GPU);
                        table.image(&case.name, "rgb", outcome, GPU);
                        let alpha = case.of_camera("alpha", index);
                        let outcome = compare_images(&image.alpha, alpha, &close, GPU);
                        table.image(&case.name, "alpha", outcome, GPU);
                    }
                }
                for (class, sum) in CLASSES.iter().zip(sums) {
                    let key = format!("grad_{}.{class}", part.key());
                    let error = relative_error(&sum, case.expected(&key));
                    // The case's tolerance is ten times the floor.
                    table.check(&case.name, &key, error, 2.0 * case.tolerance(&key));
                }
            }
        }
        table.finish();
    }
}
