//! Ray-traces known geometry into posed ground-truth images.
//!
//! A mesh (glTF, OBJ or a built-in scene) becomes views with colour, alpha, depth and normals, and
//! initial points as structure-from-motion would find them. The [`Surface`] that was traced is kept,
//! so that a trained scene can be measured against it.
//!
//! ```
//! use densify_scenegen::{Options, Scene, Source};
//!
//! let options = Options { size: Some((32, 32)), train: Some(3), ..Options::default() };
//! let scene = Scene::prepare(&Source::Preset("spheres".into()), &options)?;
//! let frame = scene.render(0);
//! assert_eq!(frame.rgba.len(), 4 * 32 * 32);
//! # Ok::<(), densify_scenegen::Error>(())
//! ```

mod camera;
mod camera_light;
mod damage;
mod error;
mod gltf;
mod intersect;
mod lens;
pub mod mesh;
mod nearest;
mod obj;
mod packet;
mod panorama;
mod passers_by;
mod points;
mod presets;
mod primitives;
mod random;
mod resource;
mod rig;
mod scene;
mod shade;
mod sky;
mod surface;
pub mod texture;
mod trace;
mod tree;
mod truth;
mod write;

pub use camera::Camera;
pub use damage::Damage;
pub use error::Error;
pub use lens::{Lens, LensKind};
pub use nearest::Nearest;
pub use panorama::Panorama;
pub use points::{InitPoints, PointCollector, PointOptions};
pub use presets::{PRESETS, Preset, PresetSpec};
pub use resource::data_uri;
pub use rig::{Rig, RigKind, Survey};
pub use scene::{Generated, Options, Scene, Source, Split, View, generate, read_mesh};
pub use shade::Ambient;
pub use sky::Sky;
pub use surface::{Surface, SurfaceHit};
pub use trace::Frame;
pub use truth::{GBuffer, GroundTruth};
pub use write::{Written, check_target, contact_sheet, write};
