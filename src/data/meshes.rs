//! Triangle meshes of other programs, to be measured: PLY, glTF and OBJ.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use densify_scenegen::mesh::Model;
use densify_scenegen::read_mesh;
use glam::DVec3;

use crate::error::LoadError;
use crate::ply::Ply;

/// The extension of glTF that marks Gaussian splats.
const SPLATS: &[u8] = b"KHR_gaussian_splatting";
/// Number of bytes of a glTF file in which that extension is looked for.
const SEARCHED: u64 = 1 << 20;
/// Names of the list of a face's vertices.
const INDICES: [&str; 2] = ["vertex_indices", "vertex_index"];
/// The remedy for a file that is not a mesh.
const REMEDY: &str = "export a triangle mesh as PLY, GLB or OBJ";

/// True if a file holds a triangle mesh, and not Gaussian splats: an OBJ, a glTF without splats, or a PLY with faces.
pub fn is_mesh(path: &Path) -> bool {
    let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase());
    match extension.as_deref() {
        Some("obj") => path.is_file(),
        Some("glb" | "gltf") => {
            let mut start = Vec::new();
            let read = File::open(path).map(|file| file.take(SEARCHED).read_to_end(&mut start));
            matches!(read, Ok(Ok(_))) && !start.windows(SPLATS.len()).any(|part| part == SPLATS)
        }
        Some("ply") => Ply::open(path).is_ok_and(|ply| {
            ply.elements().iter().any(|element| element.name == "face" && element.rows > 0)
        }),
        _ => false,
    }
}

/// Reads the positions and the triangles of a mesh; polygons are divided into triangles.
///
/// # Errors
/// When the file cannot be read, is malformed, or has no triangle.
pub fn read(path: &Path) -> Result<Model, LoadError> {
    let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase());
    if extension.as_deref() == Some("ply") { read_ply(path) } else { Ok(read_mesh(path)?) }
}

fn read_ply(path: &Path) -> Result<Model, LoadError> {
    let mut ply = Ply::open(path)?;
    let (vertices, faces) = (ply.element("vertex")?, ply.element("face")?);
    let place = |name: &str| ply.elements().iter().position(|element| element.name == name);
    let list = faces.find_list(&INDICES).filter(|_| place("vertex") < place("face"));
    let Some(list) = list else {
        let path = path.display();
        return Err(LoadError::Data(format!(
            "{path}: there is no list of vertex_indices after the vertices; {REMEDY}"
        )));
    };
    let mut columns = [0; 3];
    for (column, name) in columns.iter_mut().zip(["x", "y", "z"]) {
        *column = vertices.column(path, name, REMEDY)?;
    }
    let mut model = Model { name: path.display().to_string(), ..Model::default() };
    let positions = &mut model.positions;
    ply.each_row(&vertices, &columns, |row| positions.push(DVec3::from_slice(row)))?;
    let count = model.positions.len() as f64;
    if let Some(vertex) = model.positions.iter().position(|position| !position.is_finite()) {
        return Err(LoadError::damaged(path, format!("vertex {vertex}"), "it is not finite"));
    }
    let triangles = &mut model.triangles;
    ply.each_list(&faces, list, |_, face| {
        if let Some(wrong) = face.iter().find(|&&at| !(0.0..count).contains(&at)) {
            return Err(format!("there is no vertex {wrong}"));
        }
        for corner in 2..face.len() {
            triangles.push([0, corner - 1, corner].map(|i| face[i] as u32));
        }
        Ok(())
    })?;
    if model.triangles.is_empty() {
        let path = path.display();
        return Err(LoadError::Data(format!("{path}: there is no triangle; {REMEDY}")));
    }
    Ok(model)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn written(folder: &Path, name: &str, text: &str) -> std::path::PathBuf {
        let path = folder.join(name);
        std::fs::write(&path, text).unwrap();
        path
    }

    const HEAD: &str = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\n\
                        property float z\nelement face 2\nproperty uchar flag\n";

    #[test]
    fn polygons_of_a_ply_become_triangles() {
        let folder = tempfile::tempdir().unwrap();
        let text = format!(
            "{HEAD}property list uchar int vertex_index\nend_header\n0 0 0\n1 0 0\n1 1 0\n0 1 0.5\n\
             7 4 0 1 2 3\n7 3 0 2 3\n"
        );
        let path = written(folder.path(), "a.ply", &text);
        assert!(is_mesh(&path));
        let model = read(&path).unwrap();
        assert_eq!(model.positions[3], DVec3::new(0.0, 1.0, 0.5));
        assert_eq!(model.triangles, [[0, 1, 2], [0, 2, 3], [0, 2, 3]]);
        for (from, to, word) in [
            ("7 3 0 2 3", "7 3 0 2 4", "no vertex 4"),
            ("7 3 0 2 3", "7 3 0 2 -1", "no vertex -1"),
            ("7 3 0 2 3", "7 2000 0 2 3", "length 2000"),
            ("7 3 0 2 3", "7 3 0 2", "ends here"),
            ("0 1 0.5", "0 1 nan", "vertex 3"),
            ("vertex_index", "other", "vertex_indices"),
            ("7 4 0 1 2 3\n7 3 0 2 3", "7 2 0 1\n7 0", "no triangle"),
        ] {
            let path = written(folder.path(), "b.ply", &text.replace(from, to));
            let error = read(&path).expect_err(to).to_string();
            assert!(error.contains(word) && error.contains("b.ply"), "{error}");
        }
    }

    #[test]
    fn meshes_are_told_from_splats() {
        let folder = tempfile::tempdir().unwrap();
        let splats = "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n";
        assert!(!is_mesh(&written(folder.path(), "splats.ply", splats)));
        assert!(is_mesh(&written(folder.path(), "a.obj", "v 0 0 0\n")));
        assert!(is_mesh(&written(folder.path(), "a.glb", "glTF")));
        let splats = r#"{"extensionsUsed": ["KHR_gaussian_splatting"]}"#;
        assert!(!is_mesh(&written(folder.path(), "splats.gltf", splats)));
        assert!(!is_mesh(&folder.path().join("none.obj")));
    }
}
