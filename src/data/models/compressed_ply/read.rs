//! Reads compressed splat PLY.

use std::path::Path;

use super::layout::{BOUNDS, CHUNK, WORDS};
use crate::error::LoadError;
use crate::models::ply::layout::{OFFSET, sh_degree};
use crate::models::ply::unread;
use crate::models::quantise::{from_smallest_three, quantised_logit};
use crate::models::rows::{Row, Rows, SplatFile};
use crate::models::statement::stated_in_comments;
use crate::ply::{Element, Ply};
use densify_core::gaussians::{rgb_to_dc, sh_coefficients};

/// True if a PLY file has the elements of this format.
///
/// # Errors
/// When its header is unreadable.
pub(super) fn is_compressed(path: &Path) -> Result<bool, LoadError> {
    let is_compressed = |element: &Element| {
        element.name == "chunk" || element.properties.iter().any(|p| p.name == WORDS[0])
    };
    Ok(Ply::open(path)?.elements().iter().any(is_compressed))
}

/// Reads a compressed splat PLY.
///
/// # Errors
/// When the file is unreadable or contradicts itself, a property is missing or changes what is shown but is not read, or
/// more than 1 % of the Gaussians are not finite.
pub(super) fn read(path: &Path) -> Result<SplatFile, LoadError> {
    let mut ply = Ply::open(path)?;
    let (chunk, vertex) = (ply.element("chunk")?, ply.element("vertex")?);
    let sh = ply.elements().iter().find(|element| element.name == "sh").cloned();
    let sh_degree = match &sh {
        None => 0,
        Some(sh) => sh_degree(sh).map_err(|rest| {
            LoadError::damaged(path, "element sh", format!("no degree has {rest} coefficients"))
        })?,
    };
    let rest = 3 * (sh_coefficients(sh_degree) - 1);
    let other = sh.as_ref().map(|sh| sh.rows).filter(|&rows| rows != vertex.rows);
    if chunk.rows != vertex.rows.div_ceil(CHUNK as u64) || other.is_some() {
        let problem = format!(
            "{} vertices do not match {} chunks of 256{}",
            vertex.rows,
            chunk.rows,
            other.map_or_else(String::new, |rows| format!(" and {rows} rows of colour"))
        );
        return Err(LoadError::damaged(path, "header", problem));
    }
    let has_colour_bounds = chunk.find(&["min_r"]).is_some();
    let bounds = if has_colour_bounds { &BOUNDS[..] } else { &BOUNDS[..12] };
    let mut unread = Vec::new();
    let mut columns = |element: &Element, names: Vec<String>| {
        let columns = columns(path, element, &names)?;
        unread.extend(unread::note(path, element, &names)?);
        Ok::<_, LoadError>(columns)
    };
    let names = |names: &[&str]| names.iter().map(|&name| name.to_owned()).collect();
    let bounds = columns(&chunk, names(bounds))?;
    let words = columns(&vertex, names(&WORDS))?;
    let coefficients = match &sh {
        None => Vec::new(),
        Some(sh) => columns(sh, (0..rest).map(|i| format!("f_rest_{i}")).collect())?,
    };

    let (mut chunks, mut vertices, mut bands) = (Vec::new(), Vec::new(), Vec::new());
    // Elements must be read in the order of the file.
    for element in ply.elements().to_vec() {
        match element.name.as_str() {
            "chunk" => ply.each_row(&chunk, &bounds, |row| {
                let mut all = [0.0, 0.0, 0.0, 1.0, 1.0, 1.0].repeat(3);
                for (value, &wide) in all.iter_mut().zip(row) {
                    *value = wide as f32;
                }
                chunks.push(all);
            })?,
            "vertex" => ply.each_row(&vertex, &words, |row| {
                vertices.push([row[0], row[1], row[2], row[3]].map(|word| word as u32));
            })?,
            "sh" => ply.each_row(&element, &coefficients, |row| {
                bands.extend(row.iter().map(|&byte| byte as u8));
            })?,
            _ => {}
        }
    }

    let (antialiasing, note) = stated_in_comments(path, ply.comments())?;
    let mut rows = Rows::new(sh_degree);
    let mut colours = vec![0.0; 3 + rest];
    for (index, words) in vertices.iter().enumerate() {
        let bounds = &chunks[index / CHUNK];
        for channel in 0..3 {
            for k in 0..rest / 3 {
                colours[3 + 3 * k + channel] = band(bands[index * rest + channel * (rest / 3) + k]);
            }
        }
        rows.push(row(*words, bounds, &mut colours));
    }
    let mut file = rows.finish(path)?;
    file.gaussians.origin = ply.comment_numbers(OFFSET)?.unwrap_or_default();
    file.gaussians.antialiasing = antialiasing;
    file.notes.extend(note.into_iter().chain(unread));
    Ok(file)
}

/// Decodes the four words of a Gaussian. `sh` already holds the coefficients above band 0.
fn row<'a>(words: [u32; 4], bounds: &[f32], sh: &'a mut [f32]) -> Row<'a> {
    let [position, rotation, scale, colour] = words;
    let between = |at: usize, shares: [f32; 3]| -> [f32; 3] {
        let blend = |i: usize| bounds[at + i] * (1.0 - shares[i]) + bounds[at + 3 + i] * shares[i];
        [blend(0), blend(1), blend(2)]
    };
    let (mean, log_scale) = (between(0, three(position)), between(6, three(scale)));
    let eight = |shift: u32| share(colour >> shift, 8);
    sh[..3].copy_from_slice(&between(12, [eight(24), eight(16), eight(8)]).map(rgb_to_dc));
    let opacity_logit = quantised_logit(eight(0));
    Row { mean, log_scale, quat: quaternion(rotation), opacity_logit, sh }
}

/// The lowest `bits` bits of a word as a fraction of their largest value.
fn share(word: u32, bits: u32) -> f32 {
    let max = (1u32 << bits) - 1;
    (word & max) as f32 / max as f32
}

/// Three fractions of 11, 10 and 11 bits.
fn three(word: u32) -> [f32; 3] {
    [share(word >> 21, 11), share(word >> 11, 10), share(word, 11)]
}

/// Decodes the index of the largest component, and the three others from −1/√2 to 1/√2, in the order (w, x, y, z).
fn quaternion(word: u32) -> [f32; 4] {
    let small =
        [20, 10, 0].map(|shift| (share(word >> shift, 10) - 0.5) * std::f32::consts::SQRT_2);
    from_smallest_three((word >> 30) as usize, small)
}

/// A coefficient between −4 and 4: the middle of the byte's interval, except at both ends.
fn band(byte: u8) -> f32 {
    let share = match byte {
        0 => 0.0,
        255 => 1.0,
        byte => (f32::from(byte) + 0.5) / 256.0,
    };
    (share - 0.5) * 8.0
}

fn columns(path: &Path, element: &Element, names: &[String]) -> Result<Vec<usize>, LoadError> {
    let remedy = "a compressed splat PLY has packed_position, packed_rotation, packed_scale and packed_color, \
                  and chunks with their bounds";
    names.iter().map(|name| element.column(path, name, remedy)).collect()
}
