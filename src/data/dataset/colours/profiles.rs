//! ICC profiles from what files state; `None` where that is sRGB.

use moxcms::{
    Chromaticity, CicpColorPrimaries, CicpProfile, ColorPrimaries, ColorProfile, DataColorSpace,
    MatrixCoefficients, ProfileText, ToneReprCurve, TransferCharacteristics,
};

use super::convert;
use super::{ColourSpace, Fault, Values};
use densify_core::files::one_line;

/// The exponent in `gAMA` that programs write for sRGB.
const SRGB: f64 = 1.0 / 2.2;
/// Relative tolerance of this exponent, because programs round it.
const TOLERANCE: f64 = 0.05;
/// x and y of white, red, green and blue in sRGB.
const SRGB_CHROMATICITIES: [f64; 8] = [0.3127, 0.329, 0.64, 0.33, 0.3, 0.6, 0.15, 0.06];
/// Largest difference from these that programs cause by rounding.
const ROUNDED: f64 = 0.002;
/// Longest name of a profile in a message.
const MAX_NAME: usize = 60;
const ICC: &str = "ICC profile";
const CODES: &str = "cICP";

/// The colour space of an ICC profile for RGB or grey values.
pub(super) fn from_icc(bytes: &[u8]) -> Result<Option<ColourSpace>, Fault> {
    let mut profile = ColorProfile::new_from_slice(bytes)
        .map_err(|error| Fault::new(ICC, format!("it is damaged ({error})")))?;
    let name = name(&profile);
    if let Some(codes) = profile.cicp
        && let Some(range) = high_range(codes.transfer_characteristics)
    {
        return Err(Fault::new(ICC, range));
    }
    match profile.color_space {
        DataColorSpace::Rgb => {}
        DataColorSpace::Gray => {
            let mut grey = ColorProfile::new_srgb();
            grey.cicp = None;
            let curve = profile.gray_trc.ok_or_else(|| Fault::new(ICC, "it has no grey curve"))?;
            set_curve(&mut grey, &curve);
            profile = grey;
        }
        other => {
            return Err(Fault::new(ICC, format!("{name:?} is for {other:?}, not for RGB or grey")));
        }
    }
    unless_srgb(ICC, name, profile)
}

/// Adobe RGB (1998).
pub(super) fn adobe_rgb() -> Result<Option<ColourSpace>, Fault> {
    unless_srgb("EXIF", "Adobe RGB".to_owned(), ColorProfile::new_adobe_rgb())
}

/// The colour space of the codes in `cICP` (ITU-T H.273, tables 2 and 3). The curves of video cameras (BT.709, BT.601)
/// count as sRGB, as in players: frames that FFmpeg extracts from videos state them.
pub(super) fn from_codes(primaries: u8, transfer: u8) -> Result<Option<ColourSpace>, Fault> {
    use TransferCharacteristics::*;
    let unsupported = || {
        let problem =
            format!("primaries {primaries} with transfer function {transfer} are unknown");
        Fault::new(CODES, problem)
    };
    let curve = match TransferCharacteristics::try_from(transfer).unwrap_or(Reserved) {
        Unspecified | Bt709 | Bt470M | Bt601 | Smpte240 | Iec61966 | Bt1361 | Srgb
        | Bt202010bit | Bt202012bit => Srgb,
        known @ (Linear | Bt470Bg) => known,
        high @ (Smpte2084 | Hlg) => {
            return Err(Fault::new(CODES, high_range(high).unwrap_or_default()));
        }
        _ => return Err(unsupported()),
    };
    let code = match CicpColorPrimaries::try_from(primaries) {
        Ok(CicpColorPrimaries::Unspecified) => CicpColorPrimaries::Bt709,
        Ok(known) => known,
        Err(_) => return Err(unsupported()),
    };
    if code == CicpColorPrimaries::Bt709 && curve == Linear {
        return Ok(Some(power(1.0)));
    }
    let profile = ColorProfile::new_from_cicp(CicpProfile {
        color_primaries: code,
        transfer_characteristics: curve,
        matrix_coefficients: MatrixCoefficients::Identity,
        full_range: true,
    });
    if profile.red_trc.is_none() {
        return Err(unsupported());
    }
    let name = match primaries {
        5..=7 => "BT.601".to_owned(),
        9 => "BT.2020".to_owned(),
        11 => "DCI-P3".to_owned(),
        12 => "Display P3".to_owned(),
        other => format!("cICP primaries {other}"),
    };
    unless_srgb(CODES, name, profile)
}

/// The colour space of PNG's `gAMA` and `cHRM`.
pub(super) fn from_gamma(
    exponent: Option<f64>,
    chromaticities: Option<[f64; 8]>,
) -> Result<Option<ColourSpace>, Fault> {
    let is_other = |exponent: &f64| *exponent > 0.0 && (exponent / SRGB - 1.0).abs() > TOLERANCE;
    let exponent = exponent.filter(is_other);
    let is_near =
        |all: &[f64; 8]| all.iter().zip(SRGB_CHROMATICITIES).all(|(a, b)| (a - b).abs() <= ROUNDED);
    let Some(all) = chromaticities.filter(|all| !is_near(all)) else {
        return Ok(exponent.map(power));
    };
    let [white, red, green, blue] =
        [0, 2, 4, 6].map(|i| Chromaticity::new(all[i] as f32, all[i + 1] as f32));
    let area = (green.x - red.x) * (blue.y - red.y) - (blue.x - red.x) * (green.y - red.y);
    if area.abs() < 1e-3 || [white, red, green, blue].iter().any(|c| c.y <= 0.0) {
        return Err(Fault::new("cHRM", "its primaries span no colours"));
    }
    let mut profile = ColorProfile::new_srgb();
    profile.update_rgb_colorimetry(white.to_xyyb(), ColorPrimaries { red, green, blue });
    if let Some(exponent) = exponent {
        set_curve(&mut profile, &ToneReprCurve::Parametric(vec![(1.0 / exponent) as f32]));
    }
    unless_srgb("cHRM", "the primaries in cHRM".to_owned(), profile)
}

/// Values that are linear light to the power of `exponent`.
fn power(exponent: f64) -> ColourSpace {
    let name = match exponent {
        1.0 => "linear values".to_owned(),
        other => format!("gamma {:.2}", 1.0 / other),
    };
    ColourSpace { name, values: Values::Exponent(exponent) }
}

fn set_curve(profile: &mut ColorProfile, curve: &ToneReprCurve) {
    let all = [&mut profile.red_trc, &mut profile.green_trc, &mut profile.blue_trc];
    all.into_iter().for_each(|one| *one = Some(curve.clone()));
}

fn unless_srgb(
    field: &'static str,
    name: String,
    profile: ColorProfile,
) -> Result<Option<ColourSpace>, Fault> {
    let is_srgb = convert::is_srgb(&profile).map_err(|problem| Fault::new(field, problem))?;
    Ok((!is_srgb).then(|| ColourSpace { name, values: Values::Profile(Box::new(profile)) }))
}

/// The problem of values of high dynamic range.
fn high_range(transfer: TransferCharacteristics) -> Option<String> {
    let name = match transfer {
        TransferCharacteristics::Smpte2084 => "PQ",
        TransferCharacteristics::Hlg => "HLG",
        _ => return None,
    };
    Some(format!("its values are {name} (high dynamic range)"))
}

/// The description of a profile.
fn name(profile: &ColorProfile) -> String {
    let text = match &profile.description {
        None => "",
        Some(ProfileText::PlainString(text)) => text,
        Some(ProfileText::Localizable(texts)) => texts.first().map_or("", |text| &text.value),
        Some(ProfileText::Description(text)) => &text.ascii_string,
    };
    let text: String = one_line(text.trim_matches(['\0', ' '])).chars().take(MAX_NAME).collect();
    if text.is_empty() { "an unnamed ICC profile".to_owned() } else { text }
}
