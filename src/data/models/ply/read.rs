//! Reads splat PLY files of any program that keeps the original property names.

use std::path::Path;

use super::activation;
use super::layout::{FILTER, NEAR, NORMALS_AT, OFFSET, properties, sh_degree};
use super::unread;
use crate::error::LoadError;
use crate::models::coordinates::remote_origin;
use crate::models::rows::{Row, Rows, SplatFile};
use crate::models::statement::{note as note_of, stated_in_comments};
use crate::ply::{Element, Ply, Scalar};
use densify_core::antialiasing::Antialiasing;
use densify_core::gaussians::sh_coefficients;

/// The remedy if a property is missing, which depends on the program that left it out.
fn remedy(vertices: &Element) -> &'static str {
    let has = |name: &str| vertices.find(&[name]).is_some();
    match (has("opacity") && has("scale_1"), has("f_dc_0")) {
        (true, true) if !has("scale_2") => {
            "its Gaussians are flat, as 2DGS trains them; SuperSplat opens it and exports a PLY that has a third scale, of \
             almost 0, which densify reads"
        }
        (true, false) => {
            "its Gaussians have plain colours; nerfstudio exports the coefficients with `ns-export gaussian-splat \
             --ply-color-mode sh_coeffs`; for red, green and blue from 0 to 1, they are (colour - 0.5) / 0.2820948"
        }
        _ => {
            "a splat PLY needs x y z, f_dc_0..2, opacity, scale_0..2 and rot_0..3 (a point cloud is not a splat file; \
             a dataset's initial points are read by `densify train`)"
        }
    }
}

/// Reads a splat PLY.
///
/// # Errors
/// When the file is unreadable or contradicts itself, a property is missing (as in the compressed
/// layout) or changes what is shown but is not read, or more than 1 % of the Gaussians are not finite.
pub(super) fn read(path: &Path) -> Result<SplatFile, LoadError> {
    refuse_other_colours(path)?;
    let mut ply = Ply::open(path)?;
    let vertices = ply.element("vertex")?;
    let sh_degree = sh_degree(&vertices).map_err(|rest| {
        let problem = format!("there are {rest} of them, but degrees 0 to 3 have 0, 9, 24 or 45");
        LoadError::damaged(path, "f_rest_*", problem)
    })?;
    let rest = 3 * (sh_coefficients(sh_degree) - 1);
    let remedy = remedy(&vertices);
    let names: Vec<String> = properties(sh_degree).collect();
    let mut columns = names
        .iter()
        .map(|name| vertices.column(path, name, remedy))
        .collect::<Result<Vec<_>, _>>()?;
    let (antialiasing, note) = stated_in_comments(path, ply.comments())?;
    let filter = vertices.find(&[FILTER]);
    columns.extend(filter);
    let names = [names, filter.map(|_| FILTER.to_owned()).into_iter().collect()].concat();
    let unread = unread::note(path, &vertices, &names)?;

    let offset = ply.comment_numbers(OFFSET)?;
    let is_double = |column: &usize| vertices.properties[*column].kind == Scalar::F64;
    let origin = if columns[..NORMALS_AT].iter().any(is_double) && offset.is_none() {
        match ply.comment_numbers(NEAR)? {
            Some(near) => near,
            None => origin_of(path, &vertices, &columns[..NORMALS_AT])?,
        }
    } else {
        [0.0; 3]
    };
    let mut rows = Rows::new(sh_degree);
    let mut values = vec![0f32; columns.len()];
    let mut sh = Vec::with_capacity(3 + rest);
    ply.each_row(&vertices, &columns, |row| {
        for (value, &wide) in values.iter_mut().zip(row) {
            *value = wide as f32;
        }
        for (value, (wide, origin)) in values.iter_mut().zip(row.iter().zip(origin)) {
            // Subtracting 0 keeps the sign of −0.
            *value = (wide - origin) as f32;
        }
        let fused = if filter.is_some() { fuse_filter(&mut values) } else { &values };
        push(&mut rows, fused, &mut sh, rest);
    })?;
    let mut file = rows.finish(path)?;
    file.gaussians.origin = offset.unwrap_or(origin);
    file.notes = activation::undo(&mut file.gaussians);
    if filter.is_some() {
        file.gaussians.antialiasing = Antialiasing::Narrow;
        file.notes.push(format!(
            "the 3D filter of Mip-Splatting was fused into scales and opacities; {}",
            note_of(Antialiasing::Narrow, "`filter_3D`")
        ));
    } else {
        file.gaussians.antialiasing = antialiasing;
        file.notes.extend(note);
    }
    file.notes.extend(unread);
    Ok(file)
}

/// Refuses colours that are not sRGB according to the element `color_space` of SHARP, whose value is 0 for sRGB and 1 for
/// linear colours.
fn refuse_other_colours(path: &Path) -> Result<(), LoadError> {
    const ELEMENT: &str = "color_space";
    let mut ply = Ply::open(path)?;
    let Ok(element) = ply.element(ELEMENT) else { return Ok(()) };
    let mut other = None;
    ply.each_row(&element, &[0], |row| other = other.or(row.iter().copied().find(|v| *v != 0.0)))?;
    other.map_or(Ok(()), |value| {
        let problem = format!("{value} means colours that are not sRGB");
        let remedy = "export the model with sRGB colours, as current versions of SHARP do";
        Err(LoadError::malformed(path, ELEMENT, problem, remedy))
    })
}

/// The point from which positions in f64 are measured, so that f32 can hold them; 0 unless they are far from 0.
fn origin_of(path: &Path, vertices: &Element, columns: &[usize]) -> Result<[f64; 3], LoadError> {
    let mut axes = [const { Vec::new() }; 3];
    Ply::open(path)?.each_row(vertices, columns, |row| {
        for (axis, &value) in axes.iter_mut().zip(row) {
            axis.extend(Some(value).filter(|value| value.is_finite()));
        }
    })?;
    Ok(remote_origin(axes))
}

/// Fuses the 3D filter, the last of a Gaussian's values, into its scales s and its opacity o: s′ = √(s² + f²) and o′ =
/// o·√(Πs²/Πs′²) (Mip-Splatting, equation 7 and `gaussian_model.py`). Returns the values without the filter.
fn fuse_filter(values: &mut [f32]) -> &[f32] {
    let [own @ .., filter] = values else { unreachable!("a row ends with its filter") };
    let at = own.len() - 8;
    let filter2 = f64::from(*filter).powi(2);
    let mut log_factor = 0.0;
    for log in &mut own[at + 1..at + 4] {
        let wide = f64::from(*log);
        // s is 0 where a program writes the logarithm of 0.
        let fused = 0.5 * ((2.0 * wide).exp() + filter2).ln();
        log_factor += wide - fused;
        *log = fused as f32;
    }
    // logit o′ = ln(o′/(1 − o′)), where 1/o′ = (1 + e^−logit o)/factor.
    let inverse = (1.0 + (-f64::from(own[at])).exp()) * (-log_factor).exp();
    own[at] = -((inverse - 1.0).ln()) as f32;
    own
}

/// Adds a Gaussian with these [`properties`]. `sh` is a buffer that is reused.
fn push(rows: &mut Rows, values: &[f32], sh: &mut Vec<f32>, rest: usize) {
    let (position, values) = values.split_at(3);
    let (dc, values) = values.split_at(3);
    let (bands, values) = values.split_at(rest);
    let &[opacity_logit, s0, s1, s2, w, x, y, z] = values else {
        unreachable!("a row of the layout ends with 8 values, not {}", values.len())
    };
    sh.clear();
    sh.extend_from_slice(dc);
    for k in 0..rest / 3 {
        sh.extend([0, 1, 2].map(|channel| bands[channel * (rest / 3) + k]));
    }
    rows.push(Row {
        mean: [position[0], position[1], position[2]],
        log_scale: [s0, s1, s2],
        quat: [w, x, y, z],
        opacity_logit,
        sh,
    });
}
