//! Small datasets on disk, to load and to break.

use std::path::{Path, PathBuf};

use tempfile::TempDir;

/// A dataset of three cameras around the origin, in a format, with 200 points.
pub(crate) struct Made {
    folder: TempDir,
}

pub(super) const SIZE: (u32, u32) = (20, 12);
pub(super) const NAMES: [&str; 3] = ["a.png", "b.png", "c.png"];
/// Quaternions (w x y z) and translations of camera_from_world.
const POSES: [([f64; 4], [f64; 3]); 3] = [
    ([1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 4.0]),
    ([0.8, 0.0, 0.6, 0.0], [0.5, 0.0, 4.0]),
    ([0.0, 0.0, 1.0, 0.0], [0.0, 0.25, 5.0]),
];

impl Made {
    fn with_images() -> Self {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir(folder.path().join("images")).unwrap();
        for (index, name) in NAMES.iter().enumerate() {
            image(&folder.path().join("images").join(name), SIZE, 40 * index as u8);
        }
        Self { folder }
    }

    pub(crate) fn colmap_txt() -> Self {
        let made = Self::with_images();
        made.write("sparse/0/cameras.txt", "# cameras\n1 PINHOLE 20 12 15 16 10 6\n");
        let mut images = String::from("# images\n");
        for (index, ((q, t), name)) in POSES.iter().zip(NAMES).enumerate() {
            let numbers: Vec<String> = q.iter().chain(t).map(ToString::to_string).collect();
            images += &format!("{} {} 1 {name}\n1.5 2.5 -1 3 4 7\n", index + 1, numbers.join(" "));
        }
        made.write("sparse/0/images.txt", images);
        let mut points = String::from("# points\n");
        for index in 0..200 {
            points +=
                &format!("{index} {} {} 0.5 {} 20 30 0.1 1 2\n", index % 20, index / 20, index);
        }
        made.write("sparse/0/points3D.txt", points);
        made
    }

    pub(super) fn colmap_bin() -> Self {
        let made = Self::with_images();
        let mut cameras = 1u64.to_le_bytes().to_vec();
        cameras.extend(1u32.to_le_bytes());
        cameras.extend(1u32.to_le_bytes());
        cameras.extend(20u64.to_le_bytes());
        cameras.extend(12u64.to_le_bytes());
        for value in [15f64, 16.0, 10.0, 6.0] {
            cameras.extend(value.to_le_bytes());
        }
        made.write("sparse/0/cameras.bin", cameras);
        let mut images = 3u64.to_le_bytes().to_vec();
        for (index, ((q, t), name)) in POSES.iter().zip(NAMES).enumerate() {
            images.extend((index as u32 + 1).to_le_bytes());
            images.extend(q.iter().chain(t).flat_map(|v| v.to_le_bytes()));
            images.extend(1u32.to_le_bytes());
            images.extend(name.bytes().chain([0]));
            images.extend(2u64.to_le_bytes());
            images.extend([7; 48]);
        }
        made.write("sparse/0/images.bin", images);
        let mut points = 200u64.to_le_bytes().to_vec();
        for index in 0..200u64 {
            points.extend(index.to_le_bytes());
            points.extend(
                [(index % 20) as f64, (index / 20) as f64, 0.5]
                    .iter()
                    .flat_map(|v| v.to_le_bytes()),
            );
            points.extend([index as u8, 20, 30]);
            points.extend(0.1f64.to_le_bytes());
            points.extend(1u64.to_le_bytes());
            points.extend([0; 8]);
        }
        made.write("sparse/0/points3D.bin", points);
        // Newer versions write these beside; they are to be ignored.
        made.write("sparse/0/rigs.bin", b"rigs");
        made.write("sparse/0/frames.bin", b"frames");
        made
    }

    /// nerfstudio's file. `edit` changes the JSON before it is written.
    pub(super) fn transforms(edit: impl FnOnce(&mut serde_json::Value)) -> Self {
        let made = Self::with_images();
        let mut json = serde_json::json!({
            "w": 20, "h": 12, "fl_x": 15.0, "fl_y": 16.0, "cx": 10.0, "cy": 6.0,
            "ply_file_path": "points.ply",
            "frames": POSES.iter().zip(NAMES).map(|((q, t), name)| serde_json::json!({
                "file_path": format!("./images/{name}"),
                "transform_matrix": opengl(*q, *t),
            })).collect::<Vec<_>>(),
        });
        made.write("points.ply", cloud());
        edit(&mut json);
        made.write("transforms.json", json.to_string());
        made
    }

    /// RealityCapture's table; its cameras have one focal length, the lens in `colmap_txt` two.
    pub(super) fn realitycapture() -> Self {
        let made = Self::with_images();
        made.write("cameras.csv", table());
        made.write("points3d.ply", cloud());
        made
    }

    pub(crate) fn path(&self) -> &Path {
        self.folder.path()
    }

    pub(super) fn file(&self, name: &str) -> PathBuf {
        self.path().join(name)
    }

    pub(super) fn write(&self, name: &str, contents: impl AsRef<[u8]>) {
        let path = self.file(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, contents).unwrap();
    }

    pub(super) fn remove(&self, name: &str) {
        std::fs::remove_file(self.file(name)).unwrap();
    }

    /// Replaces the first occurrence of `old` in a text file.
    pub(super) fn replace(&self, name: &str, old: &str, new: &str) {
        let text = std::fs::read_to_string(self.file(name)).unwrap();
        assert!(text.contains(old), "{name} has no {old:?}");
        self.write(name, text.replacen(old, new, 1));
    }

    /// Rewrites a binary file.
    pub(super) fn patch(&self, name: &str, edit: impl FnOnce(&mut Vec<u8>)) {
        let mut bytes = std::fs::read(self.file(name)).unwrap();
        edit(&mut bytes);
        self.write(name, bytes);
    }
}

pub(super) fn image(path: &Path, (width, height): (u32, u32), value: u8) {
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    image::RgbImage::from_pixel(width, height, [value, 100, 200].into()).save(path).unwrap();
}

/// The 200 points.
fn cloud() -> String {
    let mut ply = String::from(
        "ply\nformat ascii 1.0\nelement vertex 200\nproperty float x\nproperty float y\nproperty float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n",
    );
    for index in 0..200 {
        ply += &format!("{} {} 0.5 {index} 20 30\n", index % 20, index / 20);
    }
    ply
}

/// RealityCapture's table of the three cameras.
fn table() -> String {
    let mut table =
        "#cameras 3\n#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n".to_owned();
    for (pose, name) in POSES.into_iter().zip(NAMES) {
        let matrix = opengl(pose.0, pose.1);
        let numbers = (0..3).map(|axis| matrix[axis][3]).chain(angles(&matrix));
        let numbers: Vec<String> = numbers.map(|number| number.to_string()).collect();
        // 15 px of a picture of 20 px: 27 mm of 36 mm.
        table += &format!("images/{name},{},27,0,0,0,0,0,0,0,0\n", numbers.join(","));
    }
    table
}

/// Heading, pitch and roll `[degrees]` of a camera-to-world matrix with OpenGL axes, which is
/// Rz(−heading)·Rx(pitch)·Ry(roll).
fn angles(matrix: &[Vec<f64>]) -> [f64; 3] {
    let heading = matrix[0][1].atan2(matrix[1][1]);
    let roll = (-matrix[2][0]).atan2(matrix[2][2]);
    [heading, matrix[2][1].clamp(-1.0, 1.0).asin(), roll].map(f64::to_degrees)
}

/// The camera-to-world matrix with OpenGL axes of a COLMAP pose.
fn opengl([w, x, y, z]: [f64; 4], t: [f64; 3]) -> Vec<Vec<f64>> {
    let r = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ];
    let mut rows: Vec<Vec<f64>> = (0..3)
        .map(|i| vec![r[0][i], -r[1][i], -r[2][i], -(0..3).map(|k| r[k][i] * t[k]).sum::<f64>()])
        .collect();
    rows.push(vec![0.0, 0.0, 0.0, 1.0]);
    rows
}
