//! Measures a mesh of any program against the known surface of a scene.

use std::path::Path;

use densify_data::meshes;
use densify_run::failure::Failure;
use densify_run::finished::load;
use densify_run::{DataSpec, Observer};
use densify_train::metrics::geometry::{KnownScene, MeshErrors, measure_mesh};

/// Measures the mesh in `file`, which has the coordinates of the dataset at `scene`.
///
/// # Errors
/// When a file cannot be read, or the surface of the scene is not known.
pub fn score(
    file: &Path,
    scene: &Path,
    data: &DataSpec,
    observer: &dyn Observer,
) -> Result<MeshErrors, Failure> {
    let mesh = meshes::read(file)?;
    let dataset = load(scene, data, observer)?;
    let Some(truth) = dataset.ground_truth()? else {
        let scene = scene.display();
        return Err(Failure::input(format!(
            "--scene: the surface of {scene} is not known; a mesh can be measured in a built-in scene, or in one that \
             `densify scenegen` wrote"
        )));
    };
    let known = KnownScene {
        truth: &truth,
        normalisation: &dataset.normalisation,
        background: data.background.fixed(),
        sh_degree: 0,
        is_stopped: &|| false,
    };
    let cameras = dataset.train.iter().map(|view| &view.camera);
    measure_mesh(&mesh, &known, cameras).map_err(Failure::input)
}
