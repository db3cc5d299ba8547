//! Reads the CSV file that RealityCapture (RealityScan) exports as "Internal/External camera parameters".
//!
//! A line per photograph: `#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2`, angles in degrees;
//! RealityScan 2 names the same `yaw`, `f_35mm`, `px_norm` and `py_norm`. With all angles 0 a camera looks straight down, its image's upper side to the north (+y); heading turns it clockwise
//! about the vertical, pitch lifts its view towards the horizon, roll tilts it (Capturing Reality, *Registration
//! export and camera orientations*). `f` is the focal length of a picture whose longer side is 36 mm; `px` and
//! `py` are the principal point from the middle, in longer sides. Distortion is that of Brown: k1 to k4 of r² to
//! r⁸; t1 and t2 are OpenCV's p2 and p1, the order in which its own OpenCV export writes them.
//!
//! The table is read here, without a crate for tables: its template writes plain commas and decimal points
//! whatever the system's language, and names without quotes. Quotes are understood all the same.

use std::fs;
use std::path::{Path, PathBuf};

use glam::{DMat3, DVec2, DVec3};

use super::folders::Folders;
use super::formats::DatasetFormat;
use super::images;
use super::lens::table::Term;
use super::lens::{Distortion, Lens, Plane};
use super::paths::{DataPath, Root, relative};
use super::pose::{check_lens, checked_pose};
use super::transforms::usual_points;
use super::{DatasetError, Frame, Scene};
use crate::points::read_points;
use densify_core::files;

/// Largest file read `[bytes]`: some 200 per photograph.
const MAX_BYTES: u64 = 256 << 20;
/// Files that are looked at in the dataset's folder.
const MAX_CANDIDATES: usize = 64;
const MAX_FRAMES: usize = 1_000_000;
const REMEDY: &str = "export \"Internal/External camera parameters\" again";
/// Width of the film that focal lengths are told for `[mm]`.
const FILM: f64 = 36.0;
/// Columns that must be there; the first by which a file is known.
const NEEDED: [&str; 8] = ["name", "x", "y", "alt", "heading", "pitch", "roll", "f"];
/// Columns of the distortion; those that are missing are 0.
const DISTORTION: [(&str, Term); 6] = [
    ("k1", Term::Radial(0)),
    ("k2", Term::Radial(1)),
    ("k3", Term::Radial(2)),
    ("k4", Term::Radial(3)),
    ("t1", Term::Tangential(1)),
    ("t2", Term::Tangential(0)),
];
/// What RealityScan 2 calls columns, and their older names.
const RENAMED: [(&str, &str); 4] =
    [("yaw", "heading"), ("f_35mm", "f"), ("px_norm", "px"), ("py_norm", "py")];

/// The format.
pub(super) const FORMAT: DatasetFormat = DatasetFormat {
    name: "realitycapture",
    file: "cameras.csv",
    marker: "a .csv of RealityCapture's camera parameters",
    read: |root, options| {
        let Some(file) = find(root)? else { return Ok(None) };
        let [inside, beside] = [true, false].map(|within| Folders::new(root, options, within));
        read(root, &file, &[inside?, beside?]).map(Some)
    },
};

/// The file in the dataset's folder, if there is one, whatever its name.
///
/// # Errors
/// When there are several: they may be of different scenes.
fn find(root: &Root) -> Result<Option<PathBuf>, DatasetError> {
    let is_csv = |name: &str| name.to_ascii_lowercase().ends_with(".csv");
    let entries = fs::read_dir(root.path()).into_iter().flatten().flatten();
    let names = entries.filter_map(|entry| entry.file_name().into_string().ok());
    let mut names: Vec<String> = names.filter(|name| is_csv(name)).collect();
    names.sort();
    let mut found = Vec::new();
    for name in names.iter().take(MAX_CANDIDATES) {
        let path = root.path().join(name);
        let Ok(text) = files::read_text(&path, MAX_BYTES) else { continue };
        if text.lines().take(3).any(|line| Columns::of(line).is_some()) {
            root.existing(DataPath { file: &path, field: "the file", value: name })?;
            found.push(path);
        }
    }
    if found.len() > 1 {
        let [first, second] = [0, 1].map(|i| found[i].display());
        return Err(DatasetError(format!(
            "{first} and {second} both list cameras; leave only the one that belongs to the photographs"
        )));
    }
    Ok(found.pop())
}

/// Reads the file. Photographs are looked for in the first of the folders, then in the second: names do not say
/// where these are.
///
/// # Errors
/// When a line is damaged, or a camera is none.
fn read(root: &Root, path: &Path, folders: &[Folders; 2]) -> Result<Scene, DatasetError> {
    let text = files::read_text(path, MAX_BYTES).map_err(DatasetError::io(path))?;
    let mut lines = (1..).zip(text.lines()).filter(|(_, line)| !line.trim().is_empty());
    let Some(columns) = lines.find_map(|(_, line)| Columns::of(line)) else {
        return Err(DatasetError::malformed(
            path,
            "the first line",
            "it does not name the columns",
            REMEDY,
        ));
    };
    let (mut frames, mut missing, mut fell_back, mut first_missing) =
        (Vec::new(), Vec::new(), 0, None);
    for (number, line) in lines {
        if frames.len() + missing.len() == MAX_FRAMES {
            return Err(DatasetError::malformed(
                path,
                "the file",
                "it lists more than a million",
                REMEDY,
            ));
        }
        let row = Row { path, number, columns: &columns, cells: cells(line) };
        let name = row.text("name").trim();
        let field = format!("line {number}: name");
        let named = DataPath { file: path, field: &field, value: name };
        let [first, second] = folders;
        let (folders, found) = match first.image(named)? {
            Some(found) => (first, found),
            None => {
                let Some(found) = second.image(named)? else {
                    first_missing.get_or_insert_with(|| first.place(named));
                    missing.push(name.to_owned());
                    continue;
                };
                (second, found)
            }
        };
        fell_back += usize::from(found.fell_back);
        let origin = format!("line {number} ({name})");
        let (rotation, translation) = row.pose(&origin)?;
        let lens = row.lens(&origin, &found.path, found.reduced)?;
        let mask = folders.mask(&found, named)?;
        frames.push(Frame {
            name: found.name,
            id: None,
            origin: format!("{}: {origin}", path.display()),
            listed: relative(name),
            image: found.path,
            reduced: found.reduced,
            mask,
            lens,
            is_sized: false,
            rotation,
            translation,
            held_out: false,
        });
    }
    let mut notes = Vec::new();
    if let Some(first) = missing.first() {
        let (missing, all) = (missing.len(), missing.len() + frames.len());
        let file = path.file_name().unwrap_or_default().display();
        notes.push(format!(
            "{file}: {missing} of {all} photographs are not there and are skipped ({first} is the first)"
        ));
    }
    if fell_back > 0 {
        notes.push(folders[0].fell_back_note(fell_back));
    }
    let points_file = usual_points(root, path, &mut notes)?;
    let points = points_file.as_deref().map(read_points).transpose()?;
    let (points, listing) = (points.unwrap_or_default(), path.to_owned());
    Ok(Scene { listing, frames, first_missing, points, points_file, notes, ..Scene::default() })
}

/// The names of the columns, in lower case; the older of two.
struct Columns(Vec<String>);

impl Columns {
    /// Those of a line that names them.
    fn of(line: &str) -> Option<Self> {
        let name = |cell: String| {
            let name = cell.trim().trim_start_matches('#').to_ascii_lowercase();
            let older = RENAMED.iter().find(|(newer, _)| *newer == name);
            older.map_or(name, |(_, older)| (*older).to_owned())
        };
        let names: Vec<String> = cells(line).into_iter().map(name).collect();
        NEEDED.iter().all(|needed| names.iter().any(|name| name == needed)).then_some(Self(names))
    }
}

/// The cells of a line; those in quotes may hold commas.
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

/// One line.
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

    /// A number; 0 where there is no such column, unless it is needed.
    fn number(&self, column: &str) -> Result<f64, DatasetError> {
        let text = self.text(column).trim();
        if text.is_empty() && !NEEDED.contains(&column) {
            return Ok(0.0);
        }
        text.parse().map_err(|_| {
            let place = format!("line {}: {column}", self.number);
            DatasetError::malformed(self.path, place, format!("{text:?} is not a number"), REMEDY)
        })
    }

    /// camera_from_world with OpenCV axes.
    fn pose(&self, frame: &str) -> Result<(DMat3, DVec3), DatasetError> {
        let angle = |column| self.number(column).map(f64::to_radians);
        let (heading, pitch, roll) = (angle("heading")?, angle("pitch")?, angle("roll")?);
        let centre = DVec3::new(self.number("x")?, self.number("y")?, self.number("alt")?);
        let world_from_camera = DMat3::from_rotation_z(-heading)
            * DMat3::from_rotation_x(pitch)
            * DMat3::from_rotation_y(roll)
            // Of a camera that looks straight down: right is east, down is south.
            * DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
        let (rotation, centre) =
            checked_pose(self.path, frame, world_from_camera.transpose(), centre)?;
        Ok((rotation, -(rotation * centre)))
    }

    /// The lens at the size of the image, which the file does not tell.
    fn lens(&self, frame: &str, image: &Path, reduced: Option<u32>) -> Result<Lens, DatasetError> {
        let header = images::probe(image)?;
        let k = reduced.unwrap_or(1);
        let (width, height) = (header.width * k, header.height * k);
        let longer = f64::from(width.max(height));
        let mut distortion = Distortion::of(Plane::Perspective);
        for (column, term) in DISTORTION {
            distortion.set(term, self.number(column)?);
        }
        let middle = 0.5 * DVec2::new(f64::from(width), f64::from(height));
        let principal = middle + longer * DVec2::new(self.number("px")?, self.number("py")?);
        let focal = DVec2::splat(self.number("f")? * longer / FILM);
        let lens = Lens::new((width, height), focal, principal, distortion);
        check_lens(self.path, frame, &lens)?;
        Ok(lens)
    }
}
