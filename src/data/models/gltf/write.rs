//! Writes binary glTF 2.0 in f32, with log-scales and opacity logits as additional attributes, which other programs
//! ignore. The node holds the half turn from the dataset's frame into that of glTF.

use std::io::{self, Write};

use serde_json::{Value, json};

use super::layout::{HALF_TURN, LOG_SCALE, MAGIC, OPACITY_LOGIT, SHAPES, SPLATS, coefficient};
use crate::models::statement::KERNEL;
use crate::models::write::unfit;
use crate::models::{Frame, ModelWriter, Shape};
use densify_core::antialiasing::Antialiasing;
use densify_core::gaussians::{Gaussians, sh_coefficients, sigmoid};

/// Attributes before those of colour, each with its number of components.
const ATTRIBUTES: [(&str, usize); 6] = [
    ("POSITION", 3),
    ("ROTATION", 4),
    ("SCALE", 3),
    ("OPACITY", 1),
    (LOG_SCALE, 3),
    (OPACITY_LOGIT, 1),
];

/// Holds the values of all Gaussians by attribute, because the bounds of positions come first in the file.
#[derive(Default)]
pub(super) struct GlbWriter {
    sh_degree: u8,
    frame: Frame,
    antialiasing: Antialiasing,
    columns: Vec<Vec<f32>>,
}

impl ModelWriter for GlbWriter {
    fn held_bytes(&self, Shape { rows, sh_degree, .. }: Shape) -> u64 {
        let row = ATTRIBUTES.iter().map(|(_, width)| width).sum::<usize>();
        (rows * size_of::<f32>() * (row + 3 * sh_coefficients(sh_degree))) as u64
    }

    fn is_lossy(&self) -> bool {
        false
    }

    fn states_offset(&self) -> bool {
        true
    }

    fn begin(&mut self, shape: Shape, _out: &mut dyn Write) -> io::Result<()> {
        let Shape { rows, sh_degree, antialiasing, frame } = shape;
        if self.held_bytes(shape) > u64::from(u32::MAX - (1 << 16)) {
            return Err(unfit(
                "a GLB has at most 4 GiB; choose another format, such as ply or sog",
            ));
        }
        self.sh_degree = sh_degree;
        self.antialiasing = antialiasing;
        self.frame = frame;
        let colours = std::iter::repeat_n(3, sh_coefficients(sh_degree));
        let widths = ATTRIBUTES.iter().map(|(_, width)| *width).chain(colours);
        self.columns = widths.map(|width| Vec::with_capacity(rows * width)).collect();
        Ok(())
    }

    fn rows(&mut self, rows: &Gaussians, _out: &mut dyn Write) -> io::Result<()> {
        let [means, quats, scales, opacities, logs, logits, colours @ ..] = &mut self.columns[..]
        else {
            unreachable!("`begin` makes the columns")
        };
        means.extend_from_slice(rows.means.as_flattened());
        quats.extend(rows.quats.iter().flat_map(|[w, x, y, z]| [*x, *y, *z, *w]));
        logs.extend_from_slice(rows.log_scales.as_flattened());
        scales.extend(rows.log_scales.as_flattened().iter().map(|log| log.exp()));
        logits.extend_from_slice(&rows.opacity_logits);
        opacities.extend(rows.opacity_logits.iter().map(|&logit| sigmoid(logit)));
        for row in 0..rows.len() {
            for (column, colour) in colours.iter_mut().zip(rows.sh_of(row).chunks_exact(3)) {
                column.extend_from_slice(colour);
            }
        }
        Ok(())
    }

    fn finish(&mut self, out: &mut dyn Write) -> io::Result<()> {
        let mut text = self.document().to_string().into_bytes();
        text.resize(text.len().next_multiple_of(4), b' ');
        let data = self.columns.iter().map(|column| size_of::<f32>() * column.len()).sum::<usize>();
        let word = |number: usize| (number as u32).to_le_bytes();
        out.write_all(MAGIC)?;
        out.write_all(&[word(2), word(12 + 8 + text.len() + 8 + data)].concat())?;
        out.write_all(&[word(text.len()), *b"JSON"].concat())?;
        out.write_all(&text)?;
        out.write_all(&[word(data), *b"BIN\0"].concat())?;
        for value in self.columns.iter().flatten() {
            out.write_all(&value.to_le_bytes())?;
        }
        Ok(())
    }
}

impl GlbWriter {
    fn document(&self) -> Value {
        let full_name = |name: &str| match name {
            "POSITION" | LOG_SCALE | OPACITY_LOGIT => name.to_owned(),
            name => format!("{SPLATS}:{name}"),
        };
        let colours =
            (0..=self.sh_degree).flat_map(|l| (0..=2 * l).map(move |n| coefficient(l, n)));
        let names = ATTRIBUTES.iter().map(|(name, _)| full_name(name)).chain(colours);
        let widths = ATTRIBUTES.iter().map(|(_, width)| *width).chain(std::iter::repeat(3));
        let (mut views, mut accessors, mut offset) = (Vec::new(), Vec::new(), 0);
        let mut attributes = serde_json::Map::new();
        for ((name, width), column) in names.zip(widths).zip(&self.columns) {
            let bytes = size_of::<f32>() * column.len();
            let shape = SHAPES[width];
            attributes.insert(name, json!(views.len()));
            accessors.push(json!({
                "bufferView": views.len(), "componentType": 5126, "count": column.len() / width,
                "type": shape,
            }));
            views.push(json!({
                "buffer": 0, "byteOffset": offset, "byteLength": bytes, "target": 34_962,
            }));
            offset += bytes;
        }
        let bound = |start: f32, choose: fn(f32, f32) -> f32| {
            let values = |axis: usize| self.columns[0].iter().skip(axis).step_by(3);
            [0, 1, 2].map(|axis| values(axis).fold(start, |found, &value| choose(found, value)))
        };
        if !self.columns[0].is_empty() {
            accessors[0]["min"] = json!(bound(f32::INFINITY, f32::min));
            accessors[0]["max"] = json!(bound(f32::NEG_INFINITY, f32::max));
        }
        let mut node = json!({"mesh": 0, "rotation": HALF_TURN});
        if let Some([x, y, z]) = self.frame.offset() {
            // In glTF's frame.
            node["translation"] = json!([-x, -y, z]);
        }
        let mut document = json!({
            "asset": {
                "version": "2.0", "generator": format!("densify {}", env!("CARGO_PKG_VERSION")),
            },
            "extensionsUsed": [SPLATS],
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [node],
            "buffers": [{"byteLength": offset}],
            "bufferViews": views,
            "accessors": accessors,
            "meshes": [{"primitives": [{
                "mode": 0,
                "attributes": attributes,
                "extensions": {SPLATS: {
                    "kernel": "ellipse", "colorSpace": "srgb_rec709_display",
                    "projection": "perspective", "sortingMethod": "cameraDistance",
                }},
            }]}],
        });
        if self.antialiasing.is_on() {
            document["extras"] = json!({KERNEL: self.antialiasing});
        }
        document
    }
}
