//! What each format takes, and how near its pictures are to the model's own.

use std::fmt::Write as _;
use std::path::Path;

use super::ExportArgs;
use crate::console::Console;
use crate::threads::open_machine;
use densify_core::files::OutputError;
use densify_core::gaussians::Gaussians;
use densify_core::numbers::{grouped, percent};
use densify_data::dataset::Dataset;
use densify_data::views::ViewSource;
use densify_render::Backend;
use densify_run::RunConfig;
use densify_run::coordinate_check::CoordinateCheck;
use densify_run::failure::Failure;
use densify_run::finished::{Machine, load, views_of};
use densify_train::evaluate::Split;
use densify_train::metrics::psnr_between;

/// A format that was written.
pub(super) struct Line {
    name: &'static str,
    bytes: u64,
    psnr: Option<f64>,
}

impl Line {
    pub(super) fn of(name: &'static str, path: &Path, psnr: Option<f64>) -> Result<Self, Failure> {
        let bytes = path.metadata().map_err(OutputError::io("read", path))?.len();
        Ok(Self { name, bytes, psnr })
    }
}

/// The model itself, on the views that were held out.
pub(super) struct Truth {
    dataset: Dataset,
    machine: Machine,
    /// Distance `[scene units]`.
    near: f32,
    background: [f32; 3],
    sh_degree: u8,
    backend: Box<dyn Backend>,
}

impl Truth {
    pub(super) fn open(
        args: &ExportArgs,
        is_run: bool,
        scene: &Path,
        model: &Gaussians,
        console: &Console,
    ) -> Result<Self, Failure> {
        let (mut data, near) = match is_run {
            true => {
                let spec = RunConfig::read(&args.model)?.spec;
                (spec.data, spec.start.near.0)
            }
            false => (args.rendering.data.clone(), args.rendering.near.0),
        };
        data.eval = data.test_every.is_none();
        let machine = open_machine(&args.rendering.device, console)?;
        let dataset = load(scene, &data, console)?;
        let near = (near * dataset.extent()) as f32;
        let mut backend = machine.backend(&dataset, model.clone(), near)?;
        let (background, sh_degree) = (data.background.fixed(), model.sh_degree);
        let views = views_of(&dataset, Split::Test)?;
        // Pictures without the model are alike in every format.
        CoordinateCheck::measure(backend.as_mut(), &views, (background, sh_degree))?.note(
            None,
            &args.model,
            console,
        );
        Ok(Self { dataset, machine, near, background, sh_degree, backend })
    }

    /// PSNR `[dB]` of another model's pictures against this one's, mean over views.
    pub(super) fn compare(&mut self, other: Gaussians) -> Result<f64, Failure> {
        let degree = other.sh_degree;
        let mut backend = self.machine.backend(&self.dataset, other, self.near)?;
        let views = views_of(&self.dataset, Split::Test)?;
        let mut sum = 0.0;
        for view in 0..views.count() {
            let camera = views.camera(view);
            let ours = self.backend.render(camera, self.background, self.sh_degree)?;
            let theirs = backend.render(camera, self.background, degree)?;
            sum += psnr_between(&ours.rgb, &theirs.rgb);
        }
        Ok(sum / views.count() as f64)
    }
}

/// A line per format.
pub(super) fn table(lines: &[Line], rows: usize) -> String {
    let of_ply = lines.iter().find(|line| line.name == "ply").map(|line| line.bytes);
    let width = lines.iter().map(|line| line.name.len()).max().unwrap_or(0).max("format".len());
    let mut text = format!("\n{:width$}  {:>15}  {:>12}", "format", "bytes", "per Gaussian");
    let columns =
        [of_ply.map(|_| "of the PLY"), lines.iter().find_map(|l| l.psnr).map(|_| "PSNR [dB]")];
    for column in columns.into_iter().flatten() {
        let _ = write!(text, "  {column:>10}");
    }
    for Line { name, bytes, psnr } in lines {
        let each = *bytes as f64 / rows.max(1) as f64;
        let shown = grouped(usize::try_from(*bytes).unwrap_or(usize::MAX));
        let _ = write!(text, "\n{name:width$}  {shown:>15}  {each:>12.1}");
        if let Some(ply) = of_ply {
            let _ = write!(text, "  {:>10}", percent(*bytes as f64 / ply as f64));
        }
        match psnr {
            None => {}
            Some(psnr) if psnr.is_infinite() => text += "        same",
            Some(psnr) => _ = write!(text, "  {psnr:>10.2}"),
        }
    }
    text
}
