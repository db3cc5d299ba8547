//! The recipe: which settings are tried in which order, and which of the models they lead to is taken.

use std::collections::HashMap;
use std::fs;
use std::path::{Path, PathBuf};

use glam::{DQuat, DVec3};
use serde::Deserialize;
use serde_json::{Value, json};

use crate::checks::{self, Pair, Verdict, View};
use crate::engine::Engine;
use crate::error::PosesError;
use crate::model::Model;
use densify_run::Observer;

/// Contrast from which on SIFT finds a keypoint: the usual one, and one for pictures with few.
const PEAK_THRESHOLDS: [f64; 2] = [0.02 / 3.0, 0.002];
/// With fewer keypoints per photograph the lower threshold is used at once.
const FEW_KEYPOINTS: u64 = 300;
/// With this share of accepted photographs, nothing further is tried.
const ENOUGH: f64 = 0.95;
/// Largest side at which keypoints are searched `[px]`.
const MAX_SIDE: u32 = 3200;
/// Up to this many photographs, all pairs are matched.
const ALL_PAIRS: usize = 200;
/// Neighbours that are matched in a sequence.
const WINDOW: usize = 10;
/// Seed of every random choice of the engine.
const SEED: u32 = 1;
/// A model has at least this many photographs.
pub(crate) const MIN_VIEWS: usize = 3;

/// What is to be reconstructed.
#[derive(Debug)]
pub(crate) struct Task<'a> {
    /// Folder with the photographs under the names below.
    pub(crate) images: PathBuf,
    /// Names without spaces, in order.
    pub(crate) names: Vec<String>,
    /// Photographs by camera, as indices of names.
    pub(crate) groups: Vec<Vec<usize>>,
    /// Folder with the masks as NAME.png, if there are any.
    pub(crate) masks: Option<PathBuf>,
    /// True if the photographs are frames of a video.
    pub(crate) is_sequence: bool,
    pub(crate) camera_model: &'a str,
    pub(crate) threads: u32,
    /// Folder of intermediate results.
    pub(crate) work: &'a Path,
}

/// A model with what the checks say about it.
#[derive(Debug)]
pub(crate) struct Candidate {
    pub(crate) model: Model,
    /// In the order of the model's images.
    pub(crate) verdict: Verdict,
    /// The settings that led to it, for the report.
    pub(crate) origin: String,
}

impl Candidate {
    /// Number of accepted views; none if the model is not to be believed.
    pub(crate) fn accepted(&self) -> usize {
        if self.verdict.is_hopeless() { 0 } else { self.verdict.accepted() }
    }
}

/// Tries the settings in turn until enough photographs are accepted. The candidates with most accepted views come first.
pub(crate) fn reconstruct(
    task: &Task<'_>,
    engine: &Engine,
    observer: &dyn Observer,
) -> Result<Vec<Candidate>, PosesError> {
    let mut found: Vec<Candidate> = Vec::new();
    if !task.is_sequence && task.names.len() > ALL_PAIRS {
        observer.say(format_args!(
            "note     over {ALL_PAIRS} photographs: each is compared with its neighbours by name, and every tenth with \
             every tenth"
        ));
    }
    for (level, peak) in PEAK_THRESHOLDS.into_iter().enumerate() {
        let folder = task.work.join(format!("attempt{level}"));
        fs::create_dir_all(&folder)
            .map_err(densify_core::files::FileError::io("create the folder", &folder))?;
        let request = task.request(&folder, peak);
        let counts =
            engine.run("features", request.clone(), &folder.join("features.json"), observer)?;
        let keypoints = median(&counts["keypoints"]);
        observer.say(format_args!("features {keypoints} per photograph"));
        if level == 0 && keypoints < FEW_KEYPOINTS {
            continue;
        }
        engine.run("pairs", request.clone(), &folder.join("pairs.json"), observer)?;
        let mappers: &[&str] = if level == 0 {
            &["incremental", "global"]
        } else {
            &["incremental", "relaxed", "global"]
        };
        for mapper in mappers {
            let models = folder.join(mapper);
            let mut request = request.clone();
            request["mapper"] = (*mapper).into();
            request["models"] = models.to_string_lossy().into();
            let done =
                engine.run("mapping", request, &folder.join(format!("{mapper}.json")), observer)?;
            for number in done["models"].as_array().into_iter().flatten() {
                let candidate =
                    task.candidate(&models.join(number.to_string()), (mapper, level))?;
                if candidate.model.images.len() < MIN_VIEWS {
                    continue;
                }
                let (registered, accepted) =
                    (candidate.model.images.len(), candidate.verdict.accepted());
                let hopeless =
                    if candidate.verdict.is_hopeless() { ", not to be believed" } else { "" };
                observer.say(format_args!(
                    "model    {}: {registered} of {} photographs placed, {accepted} confirmed by others{hopeless}",
                    candidate.origin,
                    task.names.len()
                ));
                found.push(candidate);
            }
            // Of equal ones the first stays first.
            found.sort_by_key(|candidate| std::cmp::Reverse(candidate.accepted()));
            let best = found.first().map_or(0, Candidate::accepted);
            if best as f64 >= ENOUGH * task.names.len() as f64 {
                return Ok(found);
            }
        }
    }
    Ok(found)
}

fn median(counts: &Value) -> u64 {
    let mut counts: Vec<u64> =
        counts.as_array().into_iter().flatten().filter_map(Value::as_u64).collect();
    counts.sort_unstable();
    counts.get(counts.len() / 2).copied().unwrap_or_default()
}

/// A pair as the engine writes it.
#[derive(Debug, Deserialize)]
struct Evidence {
    first: String,
    second: String,
    inliers: u32,
    /// w, x, y, z.
    rotation: [f64; 4],
    translation: Option<[f64; 3]>,
}

impl Task<'_> {
    fn request(&self, folder: &Path, peak: f64) -> Value {
        let groups: Vec<Vec<&String>> = self
            .groups
            .iter()
            .map(|group| group.iter().map(|&index| &self.names[index]).collect())
            .collect();
        json!({
            "database": folder.join("database.db").to_string_lossy(),
            "folder": folder.to_string_lossy(),
            "images": self.images.to_string_lossy(),
            "masks": self.masks.as_ref().map(|masks| masks.to_string_lossy()),
            "names": self.names,
            "groups": groups,
            "camera_model": self.camera_model,
            "max_image_size": MAX_SIDE,
            "peak_threshold": peak,
            "min_model_size": (self.names.len() / 2).clamp(MIN_VIEWS, 10),
            "seed": SEED,
            "threads": self.threads,
            "window": if self.is_sequence || self.names.len() > ALL_PAIRS { WINDOW } else { 0 },
        })
    }

    /// Reads and checks a model.
    fn candidate(
        &self,
        folder: &Path,
        (mapper, level): (&str, usize),
    ) -> Result<Candidate, PosesError> {
        let nonsense = |file: &str, problem: String| PosesError::Nonsense {
            file: folder.join(file),
            problem,
            work: self.work.to_owned(),
        };
        let model = Model::read(folder).map_err(|(file, problem)| nonsense(file, problem))?;
        let known: HashMap<&str, usize> =
            model.images.iter().enumerate().map(|(at, image)| (&*image.name, at)).collect();
        if let Some(image) = model.images.iter().find(|image| !self.names.contains(&image.name)) {
            return Err(nonsense(
                "images.bin",
                format!("{} is none of the photographs", image.name),
            ));
        }
        let file = "pairs.json";
        let text =
            fs::read(folder.join(file)).map_err(|error| nonsense(file, error.to_string()))?;
        let evidence: Vec<Evidence> =
            serde_json::from_slice(&text).map_err(|error| nonsense(file, error.to_string()))?;
        let mut pairs = Vec::with_capacity(evidence.len());
        for Evidence { first, second, inliers, rotation: [w, x, y, z], translation } in evidence {
            let (Some(&first), Some(&second)) = (known.get(&*first), known.get(&*second)) else {
                return Err(nonsense(
                    file,
                    format!("{first} and {second} are no pair of the model"),
                ));
            };
            let rotation = DQuat::from_xyzw(x, y, z, w);
            if !rotation.is_normalized() || first == second {
                return Err(nonsense(file, "a rotation has not the length 1".to_owned()));
            }
            let direction = translation
                .map(DVec3::from_array)
                .filter(|direction| direction.length_squared() > 0.0);
            pairs.push(Pair { views: [first, second], inliers, rotation, direction });
        }
        let focal: HashMap<u32, f64> =
            model.cameras.iter().map(|camera| (camera.id, camera.parameters[0])).collect();
        let view = |image: &crate::model::Image| View {
            rotation: image.rotation,
            translation: image.translation,
            points: image.points(),
            focal_px: focal[&image.camera],
        };
        let views: Vec<View> = model.images.iter().map(view).collect();
        let verdict = checks::check(&views, &pairs);
        let contrast = if level == 0 { "" } else { ", low contrast" };
        Ok(Candidate { verdict, origin: format!("{mapper} mapper{contrast}"), model })
    }
}
