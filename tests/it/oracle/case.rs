//! Reads the stored cases: `*.safetensors` files and `index.json`.

use std::collections::BTreeMap;
use std::path::Path;

use densify::core::antialiasing::Antialiasing;
use densify::core::camera::Camera;
use densify::core::gaussians::Gaussians;
use glam::{DMat3, DMat4};
use safetensors::{Dtype, SafeTensors};

use densify::selftest::reference::Upstream;

/// One scene and its stored results.
#[derive(Debug)]
pub(super) struct Case {
    pub(super) name: String,
    pub(super) sh_degree: u8,
    pub(super) model: Gaussians,
    pub(super) cameras: Vec<Camera>,
    pub(super) background: [f32; 3],
    /// Relative error of each quantity if it is computed in `f32`.
    floors: BTreeMap<String, f64>,
    arrays: BTreeMap<String, Vec<f64>>,
}

/// The images that contribute to a stored loss.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Part {
    Colour,
    Alpha,
    Depth,
    Full,
}

impl Part {
    pub(super) const ALL: [Self; 4] = [Self::Colour, Self::Alpha, Self::Depth, Self::Full];

    /// The name of this part in array names.
    pub(super) fn key(self) -> &'static str {
        match self {
            Self::Colour => "color",
            Self::Alpha => "alpha",
            Self::Depth => "depth",
            Self::Full => "full",
        }
    }
}

/// All cases.
pub(super) fn cases() -> Vec<Case> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/oracle");
    let text = std::fs::read_to_string(folder.join("index.json")).expect("the stored cases");
    let index: serde_json::Value = serde_json::from_str(&text).expect("index.json is JSON");
    let cases = index["cases"].as_object().expect("index.json lists cases");
    assert!(!cases.is_empty(), "index.json lists no case");
    cases.iter().map(|(name, entry)| Case::read(&folder, name, entry)).collect()
}

impl Case {
    fn read(folder: &Path, name: &str, entry: &serde_json::Value) -> Self {
        let file = folder.join(entry["file"].as_str().expect("a case names its file"));
        let bytes = std::fs::read(&file).expect("a case's file can be read");
        let tensors = SafeTensors::deserialize(&bytes).expect("a case's file is safetensors");
        let mut arrays = BTreeMap::new();
        for (key, tensor) in tensors.tensors() {
            arrays.insert(key, numbers(tensor.dtype(), tensor.data()));
        }
        let number = |key: &str| entry[key].as_u64().expect("a size") as u32;
        let (width, height) = (number("width"), number("height"));
        let sh_degree = number("sh_degree_active") as u8;
        let floors = &entry["conventions"]["gsplat"]["f32_floor"];
        let floors = floors.as_object().expect("a case has floors");
        Self {
            name: name.into(),
            sh_degree,
            model: model(&arrays, sh_degree),
            cameras: cameras(&arrays, width, height),
            background: std::array::from_fn(|c| arrays["in.background"][c] as f32),
            floors: floors
                .iter()
                .map(|(key, value)| (key.clone(), value.as_f64().expect("a floor is a number")))
                .collect(),
            arrays,
        }
    }

    /// A stored array that follows our conventions.
    pub(super) fn expected(&self, key: &str) -> &[f64] {
        self.array(&format!("gsplat.{key}"))
    }

    fn array(&self, key: &str) -> &[f64] {
        self.arrays.get(key).unwrap_or_else(|| panic!("{}: no array {key}", self.name))
    }

    /// The part of one camera in an array whose first axis is the camera.
    pub(super) fn of_camera(&self, key: &str, camera: usize) -> &[f64] {
        self.split(self.expected(key), camera)
    }

    fn split<'a>(&self, values: &'a [f64], camera: usize) -> &'a [f64] {
        let n = values.len() / self.cameras.len();
        &values[camera * n..(camera + 1) * n]
    }

    /// True for pixels that are not near a threshold of the renderer. Shape: [height, width].
    pub(super) fn away_from_thresholds(&self, camera: usize) -> Vec<bool> {
        self.split(self.array("pixel_ok"), camera).iter().map(|&ok| ok > 0.0).collect()
    }

    /// The weights of a stored loss.
    pub(super) fn upstream(&self, camera: usize, part: Part) -> Upstream {
        let take = |key: &str, own_part: Part| -> Vec<f64> {
            let weights = self.split(self.array(&format!("loss_weight.{key}")), camera);
            let is_included = part == own_part || part == Part::Full;
            weights.iter().map(|w| if is_included { *w } else { 0.0 }).collect()
        };
        Upstream {
            rgb: take("rgb", Part::Colour),
            alpha: take("alpha", Part::Alpha),
            depth: take("depth", Part::Depth),
        }
    }

    /// Ten times the `f32` error of this quantity. If it was not measured, the largest error of the same parameter
    /// class in another loss is used, or else of any gradient.
    pub(super) fn tolerance(&self, key: &str) -> f64 {
        let class = key.rsplit('.').next().unwrap_or(key);
        let largest = |matches: &dyn Fn(&str) -> bool| {
            let floors = self.floors.iter().filter(|(k, _)| !k.contains(':') && matches(k));
            floors.map(|(_, &floor)| floor).reduce(f64::max)
        };
        let floor = self.floors.get(key).copied();
        let floor = floor.or_else(|| largest(&|k| k.ends_with(&format!(".{class}"))));
        10.0 * floor.or_else(|| largest(&|k| k.starts_with("grad_"))).expect("a case has floors")
    }
}

fn numbers(dtype: Dtype, data: &[u8]) -> Vec<f64> {
    fn each<const N: usize>(data: &[u8], read: impl Fn([u8; N]) -> f64) -> Vec<f64> {
        let (chunks, rest) = data.as_chunks::<N>();
        assert!(rest.is_empty(), "a tensor with a partial number");
        chunks.iter().map(|&bytes| read(bytes)).collect()
    }
    match dtype {
        Dtype::F64 => each(data, f64::from_le_bytes),
        Dtype::F32 => each(data, |b| f64::from(f32::from_le_bytes(b))),
        Dtype::I32 => each(data, |b| f64::from(i32::from_le_bytes(b))),
        Dtype::U8 => each(data, |[b]| f64::from(b)),
        other => panic!("no case holds {other:?}"),
    }
}

/// Inputs are stored as `f32`, so the conversion is exact.
fn model(arrays: &BTreeMap<String, Vec<f64>>, sh_degree: u8) -> Gaussians {
    let values = |key: &str| -> Vec<f32> { arrays[key].iter().map(|&v| v as f32).collect() };
    fn rows<const N: usize>(values: &[f32]) -> Vec<[f32; N]> {
        values.as_chunks::<N>().0.to_vec()
    }
    Gaussians {
        sh_degree,
        origin: [0.0; 3],
        antialiasing: Antialiasing::None,
        means: rows(&values("in.means")),
        log_scales: rows(&values("in.log_scales")),
        quats: rows(&values("in.quats")),
        opacity_logits: values("in.opacity_logits"),
        sh: values("in.sh"),
    }
}

fn cameras(arrays: &BTreeMap<String, Vec<f64>>, width: u32, height: u32) -> Vec<Camera> {
    let poses = arrays["in.viewmats"].as_chunks::<16>().0;
    let intrinsics = arrays["in.Ks"].as_chunks::<9>().0;
    let camera = |(pose, k): (&[f64; 16], &[f64; 9])| {
        let pose = DMat4::from_cols_array(pose).transpose();
        Camera {
            width,
            height,
            fx: k[0],
            fy: k[4],
            cx: k[2],
            cy: k[5],
            rotation: DMat3::from_mat4(pose),
            translation: pose.w_axis.truncate(),
        }
    };
    poses.iter().zip(intrinsics).map(camera).collect()
}
