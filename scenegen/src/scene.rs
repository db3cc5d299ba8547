//! Prepares a scene from a source and options, so that its views can be rendered.
//!
//! The file exceeds 400 lines because geometry, cameras, light and exposure each depend on those before.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use glam::DVec3;
use serde::{Deserialize, Serialize};

use crate::camera::Camera;
use crate::camera_light::{CameraLight, check_vignette};
use crate::damage::Damage;
use crate::error::Error;
use crate::lens::Lens;
use crate::mesh::{FileCamera, Model, Reflection};
use crate::panorama::Panorama;
use crate::passers_by;
use crate::points::{InitPoints, PointCollector, PointOptions};
use crate::presets::{PresetSpec, Staging, open_sky, sun};
use crate::random::Draws;
use crate::rig::{Rig, RigKind};
use crate::shade::{Ambient, Lighting, TriangleFlags};
use crate::sky::Sky;
use crate::surface::Surface;
use crate::trace::{Frame, Tracer, luminances};
use crate::{gltf, obj};

/// The source of a scene.
#[derive(Debug, Clone, PartialEq)]
pub enum Source {
    /// The name of a built-in scene, or `NAME:SIZE` if it has a size.
    Preset(String),
    /// A `.gltf`, `.glb` or `.obj` file.
    File(PathBuf),
}

/// Rendering options. A field that is `None` takes the preset's value if there is one, otherwise the default.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Options {
    /// Arrangement of the cameras.
    pub rig: Option<RigKind>,
    /// Number of training views.
    pub train: Option<u32>,
    /// Number of test views, which are held out.
    pub test: Option<u32>,
    /// Image width and height `[px]`.
    pub size: Option<(u32, u32)>,
    /// Horizontal field of view `[degrees]`.
    pub fov: Option<f64>,
    /// See [`Rig::radius`].
    pub radius: Option<f64>,
    /// See [`Rig::jitter`].
    pub jitter: Option<f64>,
    /// Subsamples along each side of a pixel; 4 means 16 samples.
    pub grid: u32,
    /// Method of computing the light from the sky and from other surfaces.
    pub ambient: Option<Ambient>,
    /// An equirectangular `.hdr` or `.exr` image as the sky, in place of the built-in sky and sun.
    pub sky: Option<PathBuf>,
    /// If true, lights cast shadows.
    pub shadows: bool,
    /// If true, all materials are diffuse only.
    pub lambert: bool,
    /// Factor on all light. `None`: chosen automatically for files with lights and for images as the sky, otherwise 1.
    pub exposure: Option<f32>,
    /// Largest random change of a training view's exposure `[stops]`, from 0 to 8. Above 0, red and blue also
    /// change by up to 10 %.
    #[serde(default)]
    pub exposure_jitter: f32,
    /// Share of the light that training views lose at the corners of the picture, from 0 to 0.99.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub vignette: f32,
    /// Lens of training views; test views are always pinhole images.
    #[serde(default)]
    pub lens: Option<Lens>,
    /// Share of training views with people walking through the scene, who are masked; 0 to 1.
    #[serde(default)]
    pub passers_by: f64,
    /// Errors of the depth and of the poses that are written for training views.
    #[serde(default, skip_serializing_if = "Damage::is_none")]
    pub damage: Damage,
    /// Number and errors of the initial points.
    pub points: PointOptions,
    /// Seed of all random numbers.
    pub seed: u64,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            rig: None,
            train: None,
            test: None,
            size: None,
            fov: None,
            radius: None,
            jitter: None,
            grid: 4,
            ambient: None,
            sky: None,
            shadows: true,
            lambert: false,
            exposure: None,
            exposure_jitter: 0.0,
            vignette: 0.0,
            lens: None,
            passers_by: 0.0,
            damage: Damage::default(),
            points: PointOptions::default(),
            seed: 0,
        }
    }
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde passes a reference")]
fn is_zero(value: &f32) -> bool {
    *value == 0.0
}

/// Largest relative change of red and blue with [`Options::exposure_jitter`].
const WHITE_BALANCE: f32 = 0.1;
/// Largest [`Options::exposure_jitter`] `[stops]`.
const MAX_JITTER: f32 = 8.0;
/// Key of the random stream of exposures.
const EXPOSURES: u64 = 0x0065_7870_6f73_6564;

/// The set that a view belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Split {
    /// Views to train on.
    Train,
    /// Views held out for evaluation.
    Test,
}

/// A posed view, not yet rendered.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct View {
    /// File name without extension, such as `train/r_000`.
    pub name: String,
    /// Training or test.
    pub split: Split,
    /// Camera.
    pub camera: Camera,
}

/// Geometry, light and cameras, not yet rendered.
pub struct Scene {
    /// Name of the preset or file.
    pub name: String,
    /// Geometry and materials.
    pub model: Model,
    /// The geometry as traced.
    pub surface: Surface,
    /// All views, training views first.
    pub views: Vec<View>,
    /// Camera arrangement.
    pub rig: Rig,
    /// Options as given.
    pub options: Options,
    /// [`Options::ambient`], or its default for this scene.
    pub ambient: Ambient,
    /// Environment light.
    pub sky: Sky,
    /// [`Options::exposure`], or the automatic one.
    pub exposure: f32,
    train_cameras: Vec<Camera>,
    lighting: Lighting,
    flags: Vec<TriangleFlags>,
    /// True for views with passers-by. Shape: `[training views]`.
    has_passers: Vec<bool>,
}

/// A scene with all its rendered views, in memory.
pub struct Generated {
    /// The scene.
    pub scene: Scene,
    /// Rendered views, in the order of [`Scene::views`].
    pub frames: Vec<Frame>,
    /// Initial points.
    pub points: InitPoints,
}

/// Renders all views of a scene into memory.
///
/// # Errors
/// Those of [`Scene::prepare`].
pub fn generate(source: &Source, options: &Options) -> Result<Generated, Error> {
    let scene = Scene::prepare(source, options)?;
    let mut collector = scene.point_collector();
    let mut frames = Vec::new();
    for (i, view) in scene.views.iter().enumerate() {
        let frame = scene.render(i);
        if view.split == Split::Train {
            collector.observe(i, &frame);
        }
        frames.push(frame);
    }
    let points = collector.finish();
    Ok(Generated { scene, frames, points })
}

impl Scene {
    /// Loads or builds the geometry and places the cameras.
    ///
    /// # Errors
    /// When the preset is unknown, the file is unreadable, malformed or needs an
    /// unsupported feature, an option is out of range, no camera can be placed, or no view shows a
    /// surface.
    pub fn prepare(source: &Source, options: &Options) -> Result<Self, Error> {
        check(options)?;
        let (name, staging, cameras) = stage(source, options.seed)?;
        let Staging { mut model, mut sky, rig, ambient } = staging;
        if options.lambert {
            for material in &mut model.materials {
                if material.reflection == Reflection::MetalRough {
                    material.reflection = Reflection::Lambert;
                }
            }
        }
        let surface = Surface::new(&model)?;
        let rig = with_options(rig, options);
        let (mut train, test) = rig.cameras(&surface, &cameras)?;
        if let Some(lens) = options.lens {
            train =
                train.into_iter().map(|camera| camera.with_lens(lens)).collect::<Result<_, _>>()?;
        }
        let ambient = options.ambient.unwrap_or(ambient);
        let flags = TriangleFlags::all(&surface, &model);
        let is_file = matches!(source, Source::File(_));
        let has_own_lights = is_file && !model.lights.is_empty();
        if let Some(path) = &options.sky {
            sky = Sky::Image(Arc::new(Panorama::load(path)?));
            model.lights.retain(|light| *light != sun());
        } else if is_file && !has_own_lights {
            model.lights.push(sun());
        }
        let build = |sky, grid| {
            Lighting::new(&model.lights, &surface, sky, (ambient, options.shadows, grid))
        };
        let mut exposure = options.exposure.unwrap_or(1.0);
        // Lights and skies from files have an unknown unit.
        if has_own_lights || options.sky.is_some() {
            let sky_is_fill = options.sky.is_none();
            if options.exposure.is_none() {
                let unfilled = build(if sky_is_fill { Sky::uniform(0.0) } else { sky.clone() }, 1);
                let (surface, model, flags) = (&surface, &model, &flags);
                let tracer =
                    Tracer { surface, model, flags, lighting: &unfilled, exposure: 1.0, seed: 0 };
                exposure = exposure_for(&tracer, &train);
            }
            // The built-in sky becomes fill light, in the unit of the file's lights.
            if sky_is_fill {
                sky = sky.dimmed(0.4 / exposure);
            }
        }
        let lighting = build(sky.clone(), options.grid);
        let name_of = |split: &str, i: usize| format!("{split}/r_{i:03}");
        let views = |cameras: &[Camera], split: Split, folder: &str| {
            let view =
                |(i, &camera): (usize, &Camera)| View { name: name_of(folder, i), split, camera };
            cameras.iter().enumerate().map(view).collect::<Vec<_>>()
        };
        let mut all = views(&train, Split::Train, "train");
        all.extend(views(&test, Split::Test, "test"));
        let scene = Self {
            name,
            surface,
            views: all,
            rig,
            options: options.clone(),
            ambient,
            sky,
            exposure,
            has_passers: passers_by::select_views(options.seed, train.len(), options.passers_by),
            train_cameras: train,
            lighting,
            flags,
            model,
        };
        scene.check_visible()?;
        Ok(scene)
    }

    /// Returns an error if no view shows a surface.
    fn check_visible(&self) -> Result<(), Error> {
        let tracer = self.tracer();
        let cameras = || self.views.iter().map(|view| &view.camera);
        // One ray per pixel finds most surfaces quickly; slender or faint ones may need all rays of a pixel.
        let is_visible = cameras().any(|camera| tracer.meets_surface(camera))
            || cameras().any(|camera| {
                tracer.render(camera, 0, None).rgba.chunks_exact(4).any(|pixel| pixel[3] > 0)
            });
        if is_visible {
            return Ok(());
        }
        Err(Error::Input(format!(
            "{}: none of the {} views shows a surface: the cameras look past the mesh or at the backs of one-sided \
             faces, or its materials are transparent; choose another --rig or --radius, or correct the materials",
            self.name,
            self.views.len()
        )))
    }

    /// Renders a view. The result does not depend on the number of threads.
    pub fn render(&self, view: usize) -> Frame {
        let (camera, light) = (&self.views[view].camera, self.camera_light(view));
        let mut frame = self.tracer().render(camera, view as u64, light);
        if self.has_passers.get(view) == Some(&true) {
            passers_by::draw(&mut frame, camera, self.options.seed, view, light);
        }
        frame
    }

    /// The camera that is written for a view: that of the image, or with the [errors](Options::damage) of its pose.
    pub(crate) fn written_camera(&self, view: usize) -> Camera {
        let View { split, camera, .. } = &self.views[view];
        match split {
            Split::Train => {
                let Options { damage, seed, .. } = &self.options;
                damage.camera(camera, *seed, view, self.reach())
            }
            Split::Test => *camera,
        }
    }

    /// The largest distance of a training camera from their mean.
    fn reach(&self) -> f64 {
        let train = self.views.iter().filter(|view| view.split == Split::Train);
        let centres: Vec<_> = train.map(|view| view.camera.centre).collect();
        let mean = centres.iter().sum::<DVec3>() / centres.len().max(1) as f64;
        centres.iter().map(|centre| centre.distance(mean)).fold(0.0, f64::max)
    }

    /// The depth that is written for trainers: that of the image, or with the [errors](Options::damage) of a sensor.
    pub(crate) fn written_depth(&self, view: usize, frame: &Frame) -> Vec<f32> {
        let View { split, camera, .. } = &self.views[view];
        match split {
            Split::Train if !self.options.damage.is_none() => {
                self.options.damage.depth(frame, camera, self.options.seed, view)
            }
            Split::Train | Split::Test => frame.depth.clone(),
        }
    }

    /// The factors on the channels of a training view, if [exposures vary](Options::exposure_jitter).
    pub fn gains(&self, view: usize) -> Option<[f32; 3]> {
        let stops = self.options.exposure_jitter;
        if stops == 0.0 || self.views[view].split == Split::Test {
            return None;
        }
        let mut draws = Draws::new(self.options.seed, &[EXPOSURES, view as u64]);
        let mut signed_unit = || 2.0 * draws.unit() - 1.0;
        let gain = (stops * signed_unit()).exp2();
        let [red, blue] = [signed_unit(), signed_unit()].map(|change| 1.0 + WHITE_BALANCE * change);
        Some([gain * red, gain, gain * blue])
    }

    /// What the camera does to the light of a training view, if it does anything.
    fn camera_light(&self, view: usize) -> Option<CameraLight> {
        let is_training = self.views[view].split == Split::Train;
        let vignette = if is_training { self.options.vignette } else { 0.0 };
        let gains = self.gains(view);
        let gains = gains.or((vignette > 0.0).then_some([1.0; 3]))?;
        Some(CameraLight { gains, vignette })
    }

    /// A collector of initial points, which must be given the training views as they are rendered.
    pub fn point_collector(&self) -> PointCollector<'_> {
        PointCollector::new(self.tracer(), &self.train_cameras, self.options.points)
    }

    pub(crate) fn tracer(&self) -> Tracer<'_> {
        Tracer {
            surface: &self.surface,
            model: &self.model,
            flags: &self.flags,
            lighting: &self.lighting,
            exposure: self.exposure,
            seed: self.options.seed,
        }
    }
}

fn check(options: &Options) -> Result<(), Error> {
    let share = |option, value: f64| match value {
        0.0..=1.0 => Ok(()),
        _ => Err(Error::option(option, format!("{value} is not between 0 and 1"))),
    };
    share("--point-noise", options.points.noise)?;
    share("--outliers", options.points.outliers)?;
    share("--dropout", options.points.dropout)?;
    share("--passers-by", options.passers_by)?;
    check_vignette(options.vignette)?;
    options.damage.check()?;
    if !(1..=64).contains(&options.grid) {
        return Err(Error::option(
            "--samples",
            format!("{} per side is not between 1 and 64", options.grid),
        ));
    }
    if options.points.count > 1 << 28 {
        return Err(Error::option("--points", "there can be at most 2^28 points"));
    }
    if !(0.0..=MAX_JITTER).contains(&options.exposure_jitter) {
        let stops = options.exposure_jitter;
        let problem = format!("{stops} is not between 0 and {MAX_JITTER} stops");
        return Err(Error::option("--exposure-jitter", problem));
    }
    if options.exposure.is_some_and(|e| !(e > 0.0 && e.is_finite())) {
        return Err(Error::option("--exposure", "it must be positive and finite"));
    }
    Ok(())
}

/// Reads the mesh of a `.gltf`, `.glb` or `.obj` file.
///
/// # Errors
/// When the file is unreadable, malformed, has no triangle or needs an unsupported feature.
pub fn read_mesh(path: &Path) -> Result<Model, Error> {
    let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase());
    match extension.as_deref() {
        Some("gltf" | "glb") => gltf::load(path),
        Some("obj") => obj::load(path),
        _ => {
            let feature = "a file that is neither .gltf, .glb nor .obj";
            Err(Error::unsupported(path, feature, "export the mesh to one of them"))
        }
    }
}

fn stage(source: &Source, seed: u64) -> Result<(String, Staging, Vec<FileCamera>), Error> {
    match source {
        Source::Preset(name) => {
            let spec: PresetSpec = name.parse()?;
            let mut staging = spec.build(seed);
            staging.model.name = spec.to_string();
            Ok((spec.to_string(), staging, Vec::new()))
        }
        Source::File(path) => {
            let model = read_mesh(path)?;
            let cameras = model.cameras.clone();
            let staging = Staging {
                sky: open_sky(),
                rig: Rig { elevation: [-15.0, 70.0], ..Rig::default() },
                ambient: Ambient::Open,
                model,
            };
            let name = path.file_name().map(|name| name.to_string_lossy().into_owned());
            Ok((name.unwrap_or_default(), staging, cameras))
        }
    }
}

fn with_options(rig: Rig, options: &Options) -> Rig {
    let kind = options.rig.unwrap_or(rig.kind);
    let default = Rig::default();
    // A different kind of arrangement does not inherit parameters tuned for the preset's kind.
    let rig = match kind {
        same if same == rig.kind => rig,
        RigKind::Inside => Rig {
            radius: 0.45,
            elevation: [-25.0, 15.0],
            clearance: 0.02,
            fov: 80.0,
            arc: 360.0,
            ..rig
        },
        RigKind::Survey => {
            let (radius, clearance, fov) = (default.radius, 0.002, 65.0);
            Rig { radius, clearance, fov, arc: 360.0, ..rig }
        }
        _ => Rig { arc: 360.0, radius: default.radius, clearance: default.clearance, ..rig },
    };
    let (width, height) = options.size.unwrap_or((rig.width, rig.height));
    Rig {
        kind,
        train: options.train.unwrap_or(rig.train),
        test: options.test.unwrap_or(rig.test),
        width,
        height,
        fov: options.fov.unwrap_or(rig.fov),
        radius: options.radius.unwrap_or(rig.radius),
        jitter: options.jitter.unwrap_or(rig.jitter),
        seed: options.seed,
        ..rig
    }
}

/// The exposure that brings the 98th percentile of luminance to 0.9.
fn exposure_for(tracer: &Tracer<'_>, cameras: &[Camera]) -> f32 {
    let step = cameras.len().div_ceil(6).max(1);
    let mut all = Vec::new();
    for camera in cameras.iter().step_by(step) {
        all.extend(luminances(tracer, camera, (camera.width / 48).max(1)));
    }
    all.retain(|l| l.is_finite() && *l > 0.0);
    all.sort_by(f32::total_cmp);
    match all.get(all.len() * 49 / 50) {
        Some(&bright) => (0.9 / bright).clamp(1e-9, 1e9),
        None => 1.0,
    }
}
