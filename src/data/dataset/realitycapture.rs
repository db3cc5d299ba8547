//! Reads the CSV file that RealityCapture (RealityScan) exports as "Internal/External camera parameters".
//!
//! The header is `#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2`; each line after it is a photograph, with
//! angles in degrees.
//! RealityScan 2 calls some columns `yaw`, `f_35mm`, `px_norm` and `py_norm`. With all angles 0 a camera looks straight
//! down and the top of its image is north (+y); heading turns it clockwise about the vertical, pitch raises its view
//! towards the horizon, roll tilts it sideways (Capturing Reality, *Registration export and camera orientations*). `f`
//! is the focal length for an image whose longer side is 36 mm; `px` and `py` are the offset of the principal point
//! from the centre, in units of the longer side. The distortion is Brown's: k1 to k4 of r² to r⁸; t1 and t2 are
//! OpenCV's p2 and p1, the order in which RealityCapture's own OpenCV export writes them.
//!
//! The table is parsed here rather than by a CSV crate: the export writes plain commas and decimal points whatever the
//! system's language, and names without quotes. Quotes are accepted nevertheless.

use std::fs;
use std::path::{Path, PathBuf};

use glam::{DMat3, DVec2, DVec3};

use super::folders::Folders;
use super::formats::DatasetFormat;
use super::images::{self, ImageHeader};
use super::lens::models::Term;
use super::lens::{Distortion, Lens, Projection};
use super::mask_files::Listed;
use super::paths::{DataPath, Root, existing_namesake, namesake, relative};
use super::pose::{check_lens, checked_pose};
use super::prepare::text_notes;
use super::transforms::usual_points;
use super::{Frame, LoadError, LoadOptions, Scene};
use densify_core::files;

pub(super) const FORMAT: DatasetFormat = DatasetFormat {
    name: "realitycapture",
    title: "RealityCapture",
    file: "cameras.csv",
    files: "a .csv table of its camera parameters",
    read,
};

/// Largest file read `[bytes]`; each photograph takes about 200 bytes.
const MAX_BYTES: u64 = 256 << 20;
/// Maximum number of CSV files that are examined in the dataset's folder.
const MAX_CANDIDATES: usize = 64;
const MAX_FRAMES: usize = 1_000_000;
const REMEDY: &str = "export \"Internal/External camera parameters\" again";
/// Film width for which focal lengths are stated `[mm]`.
const FILM: f64 = 36.0;
/// Required columns, which identify the table.
const NEEDED: [&str; 8] = ["name", "x", "y", "alt", "heading", "pitch", "roll", "f"];
/// Columns of the distortion; a missing one is 0.
const DISTORTION: [(&str, Term); 6] = [
    ("k1", Term::Radial(0)),
    ("k2", Term::Radial(1)),
    ("k3", Term::Radial(2)),
    ("k4", Term::Radial(3)),
    ("t1", Term::Tangential(1)),
    ("t2", Term::Tangential(0)),
];
/// Column names of RealityScan 2, and their older names.
const RENAMED: [(&str, &str); 4] =
    [("yaw", "heading"), ("f_35mm", "f"), ("px_norm", "px"), ("py_norm", "py")];

/// The table in the dataset's folder, whatever its name, if there is one.
///
/// # Errors
/// When there are several tables, as they may belong to different scenes.
fn find_table(root: &Root) -> Result<Option<PathBuf>, LoadError> {
    let is_csv = |name: &str| name.to_ascii_lowercase().ends_with(".csv");
    let entries = fs::read_dir(root.path()).into_iter().flatten().flatten();
    let names = entries.filter_map(|entry| entry.file_name().into_string().ok());
    let mut names: Vec<String> = names.filter(|name| is_csv(name)).collect();
    names.sort();
    let mut tables = Vec::new();
    for name in names.iter().take(MAX_CANDIDATES) {
        let path = root.path().join(name);
        let Ok(text) = files::read_text(&path, MAX_BYTES) else { continue };
        if text.lines().take(3).any(|line| Columns::parse(line).is_some()) {
            root.existing(DataPath { file: &path, field: "the file", value: name })?;
            tables.push(path);
        }
    }
    if tables.len() > 1 {
        let [first, second] = [0, 1].map(|i| tables[i].display());
        return Err(LoadError::Data(format!(
            "{first} and {second} both list cameras; leave only the one that belongs to the photographs"
        )));
    }
    Ok(tables.pop())
}

/// Reads the table in a folder, if there is one. Photographs are looked for in `images/`, then in the dataset's folder.
///
/// # Errors
/// When a line is damaged or a camera is impossible.
fn read(root: &Root, options: &LoadOptions) -> Result<Option<Scene>, LoadError> {
    let Some(path) = &find_table(root)? else { return Ok(None) };
    let fault =
        |place: &str, problem: &str| Err(LoadError::malformed(path, place, problem, REMEDY));
    let [in_images, in_root] = [true, false].map(|within| Folders::new(root, options, within));
    let (in_images, in_root) = (in_images?, in_root?);
    let text = files::read_text(path, MAX_BYTES).map_err(LoadError::io(path))?;
    let mut lines = (1..).zip(text.lines()).filter(|(_, line)| !line.trim().is_empty());
    let Some(columns) = lines.find_map(|(_, line)| Columns::parse(line)) else {
        return fault("the first line", "it does not name the columns");
    };
    let row = |(number, line)| Row { path, number, columns: &columns, cells: cells(line) };
    let rows: Vec<Row<'_>> = lines.map(row).take(MAX_FRAMES + 1).collect();
    let places = [&in_images, &in_root];
    let names = rows.iter().map(|row| row.text("name").trim());
    let photographs = Listed::new(&places, path, names);
    let (mut frames, mut missing, mut fell_back, mut first_missing) =
        (Vec::new(), Vec::new(), 0, None);
    for row in &rows {
        if frames.len() + missing.len() == MAX_FRAMES {
            return fault("the file", "it lists more than a million photographs");
        }
        let (number, name) = (row.number, row.text("name").trim());
        let field = format!("line {number}: name");
        let named = DataPath { file: path, field: &field, value: name };
        let (folders, found) = match in_images.image(named)? {
            Some(found) => (&in_images, found),
            None => {
                let Some(found) = in_root.image(named)? else {
                    first_missing.get_or_insert_with(|| {
                        let in_root = Some(in_root.shown_path(named));
                        let in_root = in_root.filter(|path| namesake(path).is_some());
                        in_root.unwrap_or_else(|| in_images.shown_path(named))
                    });
                    missing.push(name.to_owned());
                    continue;
                };
                (&in_root, found)
            }
        };
        fell_back += usize::from(found.fell_back);
        let origin = format!("line {number} ({name})");
        let (rotation, translation) = row.pose(&origin)?;
        let (lens, header) = row.lens(&origin, &found.path, found.reduced)?;
        let mask = folders.mask(&found, named, &photographs)?;
        let depth = folders.depth(&found, named);
        frames.push(Frame {
            name: found.name,
            id: None,
            origin: format!("{}: {origin}", path.display()),
            listed: relative(name),
            image: found.path,
            reduced: found.reduced,
            mask,
            depth,
            lens,
            header: Some(header),
            rotation,
            translation,
            held_out: false,
        });
    }
    if are_degrees(&frames) {
        let problem = "the coordinates look like longitudes and latitudes in degrees";
        let remedy = "export them in a metric coordinate system, such as `local:1 - Euclidean`";
        return Err(LoadError::malformed(path, "x, y", problem, remedy));
    }
    let mut notes = Vec::new();
    if let Some(first) = missing.first() {
        let (missing, all) = (missing.len(), missing.len() + frames.len());
        let file = path.file_name().unwrap_or_default().display();
        let other = first_missing.as_deref().map(existing_namesake).unwrap_or_default();
        notes.push(format!(
            "{file}: {missing} of {all} photographs do not exist and are skipped (first: {first}{other})"
        ));
    }
    if fell_back > 0 {
        notes.push(in_images.fell_back_note(fell_back));
    }
    let points_file = usual_points(root, path, &mut notes)?;
    let points = points_file.as_deref().map(crate::points::read_points).transpose()?;
    let (points, note) = points.unwrap_or_default();
    notes.extend(note);
    let listing = path.to_owned();
    let (notes, rest) = (text_notes(notes), Scene::default());
    Ok(Some(Scene { listing, frames, first_missing, points, points_file, notes, ..rest }))
}

/// Returns true if x and y can be degrees and vary far less than the height. A degree is 111 km; in metres, such cameras
/// would be a vertical line far from the origin of local coordinates.
fn are_degrees(frames: &[Frame]) -> bool {
    /// Largest spread of longitudes and latitudes: 11 km.
    const MAX_SPREAD: f64 = 0.1;
    /// Smallest ratio of the spreads of heights in metres and of degrees: 0.3 m for an area of 1 km.
    const RATIO: f64 = 30.0;
    let centre = |frame: &Frame| -(frame.rotation.transpose() * frame.translation);
    let empty = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    let (low, high) = frames
        .iter()
        .map(centre)
        .fold(empty, |(low, high), centre| (low.min(centre), high.max(centre)));
    let (farthest, spread) = (low.abs().max(high.abs()), high - low);
    let wide = spread.x.max(spread.y);
    let can_be_degrees = farthest.x <= 180.0 && farthest.y <= 90.0;
    let is_local = farthest.x.max(farthest.y) < 1.0 || wide == 0.0;
    can_be_degrees && !is_local && wide < MAX_SPREAD && spread.z > RATIO * wide
}

/// Column names in lower case; those of RealityScan 2 are replaced with the older ones.
struct Columns(Vec<String>);

impl Columns {
    /// Parses a header line; `None` if a required column is missing.
    fn parse(line: &str) -> Option<Self> {
        let name = |cell: String| {
            let name = cell.trim().trim_start_matches('#').to_ascii_lowercase();
            let older = RENAMED.iter().find(|(newer, _)| *newer == name);
            older.map_or(name, |(_, older)| (*older).to_owned())
        };
        let names: Vec<String> = cells(line).into_iter().map(name).collect();
        NEEDED.iter().all(|needed| names.iter().any(|name| name == needed)).then_some(Self(names))
    }
}

/// The cells of a line; quoted cells may contain commas.
fn cells(line: &str) -> Vec<String> {
    let (mut cells, mut quoted) = (vec![String::new()], false);
    for c in line.chars() {
        match c {
            '"' => quoted = !quoted,
            ',' if !quoted => cells.push(String::new()),
            _ => cells.last_mut().into_iter().for_each(|cell| cell.push(c)),
        }
    }
    cells
}

/// One line of the table.
struct Row<'a> {
    path: &'a Path,
    number: u64,
    columns: &'a Columns,
    cells: Vec<String>,
}

impl Row<'_> {
    fn text(&self, column: &str) -> &str {
        let at = self.columns.0.iter().position(|name| name == column);
        at.and_then(|at| self.cells.get(at)).map_or("", String::as_str)
    }

    /// The number in a column; 0 if the column is optional and is missing or empty.
    fn number(&self, column: &str) -> Result<f64, LoadError> {
        let text = self.text(column).trim();
        if text.is_empty() && !NEEDED.contains(&column) {
            return Ok(0.0);
        }
        text.parse().map_err(|_| {
            let place = format!("line {}: {column}", self.number);
            LoadError::malformed(self.path, place, format!("{text:?} is not a number"), REMEDY)
        })
    }

    /// The pose `camera_from_world`, with OpenCV axes.
    fn pose(&self, frame: &str) -> Result<(DMat3, DVec3), LoadError> {
        let angle = |column| self.number(column).map(f64::to_radians);
        let (heading, pitch, roll) = (angle("heading")?, angle("pitch")?, angle("roll")?);
        let centre = DVec3::new(self.number("x")?, self.number("y")?, self.number("alt")?);
        let world_from_camera = DMat3::from_rotation_z(-heading)
            * DMat3::from_rotation_x(pitch)
            * DMat3::from_rotation_y(roll)
            // The axes of the camera that looks straight down: right is east, down is south.
            * DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
        let (rotation, centre) =
            checked_pose(self.path, frame, world_from_camera.transpose(), centre)?;
        Ok((rotation, -(rotation * centre)))
    }

    /// The lens at the full size of the image, which the table does not state, and the header of the image.
    fn lens(
        &self,
        frame: &str,
        image: &Path,
        reduced: Option<u32>,
    ) -> Result<(Lens, ImageHeader), LoadError> {
        let header = images::read_header(image)?;
        let k = reduced.unwrap_or(1);
        let (width, height) = (header.width * k, header.height * k);
        let longer = f64::from(width.max(height));
        let mut distortion = Distortion::none(Projection::Perspective);
        for (column, term) in DISTORTION {
            distortion.set(term, self.number(column)?);
        }
        let middle = 0.5 * DVec2::new(f64::from(width), f64::from(height));
        let principal = middle + longer * DVec2::new(self.number("px")?, self.number("py")?);
        let focal = DVec2::splat(self.number("f")? * longer / FILM);
        let lens = Lens::new((width, height), focal, principal, distortion);
        check_lens(self.path, frame, &lens)?;
        Ok((lens, header))
    }
}
