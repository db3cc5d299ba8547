//! Finds what an image file states about its colours: chunks of PNG, EXIF of JPEG, and ICC profiles of PNG, JPEG and
//! WebP.
//!
//! Only the parts before the pixels are read. A damaged file states nothing here; its decoder reports the damage.

use std::io::{self, BufRead, Read, Seek};

use exif::{In, Tag, Value};
use flate2::read::ZlibDecoder;

/// Largest ICC profile that is read `[bytes]`; those of cameras and monitors have a few hundred bytes to a megabyte.
const MAX_PROFILE: u64 = 8 << 20;
const PNG: [u8; 8] = *b"\x89PNG\r\n\x1a\n";
/// The start of each part of an ICC profile in a JPEG, before its number and the number of parts.
const PART: &[u8; 12] = b"ICC_PROFILE\0";

/// A statement of a file about its colours.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Stated {
    /// An ICC profile.
    Profile(Vec<u8>),
    /// An ICC profile that cannot be unpacked.
    DamagedProfile,
    /// Adobe RGB, by the `InteroperabilityIndex` in EXIF.
    AdobeRgb,
    /// `cICP` of PNG: codes of the primaries and of the transfer function (ITU-T H.273, tables 2 and 3).
    Codes { primaries: u8, transfer: u8 },
    /// `gAMA` and `cHRM` of PNG.
    Gamma {
        /// The values are linear light to the power of this exponent.
        exponent: Option<f64>,
        /// x and y of white, red, green and blue.
        chromaticities: Option<[f64; 8]>,
    },
}

/// What a file states; `None` if it states nothing, or no more than that it is sRGB.
pub(super) fn read(mut input: impl BufRead + Seek) -> Option<Stated> {
    match bytes::<8>(&mut input)? {
        PNG => png(input),
        [0xff, 0xd8, ..] => {
            input.seek(io::SeekFrom::Start(2)).ok()?;
            jpeg(input)
        }
        [b'R', b'I', b'F', b'F', ..] if bytes(&mut input)? == *b"WEBP" => webp(input),
        _ => None,
    }
}

fn bytes<const N: usize>(input: &mut impl Read) -> Option<[u8; N]> {
    let mut bytes = [0; N];
    input.read_exact(&mut bytes).ok().map(|()| bytes)
}

/// The next `length` bytes, if the file has them.
fn data(input: &mut impl Read, length: u64) -> Option<Vec<u8>> {
    let mut data = Vec::new();
    input.take(length).read_to_end(&mut data).ok()?;
    (data.len() as u64 == length).then_some(data)
}

/// If several chunks state colours, `cICP` takes precedence over `iCCP`, `sRGB`, `gAMA` and `cHRM` (PNG, 3rd edition,
/// 4.3).
fn png(mut input: impl BufRead + Seek) -> Option<Stated> {
    let (mut profile, mut is_srgb, mut exponent, mut chromaticities) = (None, false, None, None);
    let scaled =
        |four: &[u8]| f64::from(u32::from_be_bytes([four[0], four[1], four[2], four[3]])) / 1e5;
    loop {
        let [a, b, c, d, kind @ ..] = bytes::<8>(&mut input)?;
        let mut rest = i64::from(u32::from_be_bytes([a, b, c, d]));
        match (&kind, rest) {
            (b"cICP", 4) => {
                let [primaries, transfer, ..] = bytes::<4>(&mut input)?;
                return Some(Stated::Codes { primaries, transfer });
            }
            (b"iCCP", 0..=0x80_0000) => {
                profile = Some(unpacked(&data(&mut input, rest as u64)?));
                rest = 0;
            }
            (b"iCCP", _) => profile = Some(Stated::DamagedProfile),
            (b"sRGB", _) => is_srgb = true,
            (b"gAMA", 4) => {
                exponent = Some(scaled(&bytes::<4>(&mut input)?));
                rest = 0;
            }
            (b"cHRM", 32) => {
                let all = bytes::<32>(&mut input)?;
                chromaticities = Some(std::array::from_fn(|i| scaled(&all[4 * i..])));
                rest = 0;
            }
            (b"IDAT" | b"IEND", _) => break,
            _ => {}
        }
        input.seek_relative(rest + 4).ok()?;
    }
    let states_gamma = !is_srgb && (exponent.is_some() || chromaticities.is_some());
    profile.or(states_gamma.then_some(Stated::Gamma { exponent, chromaticities }))
}

/// The profile in a chunk `iCCP`: a name, 0, the method 0, and compressed bytes.
fn unpacked(chunk: &[u8]) -> Stated {
    let packed = chunk.iter().position(|&byte| byte == 0).and_then(|end| chunk.get(end + 2..));
    let mut profile = Vec::new();
    let read = packed
        .map(|packed| ZlibDecoder::new(packed).take(MAX_PROFILE + 1).read_to_end(&mut profile));
    match read {
        Some(Ok(_)) if profile.len() as u64 <= MAX_PROFILE => Stated::Profile(profile),
        _ => Stated::DamagedProfile,
    }
}

/// The profile is in one or several segments `APP2`, which may be in any order; EXIF in `APP1` states Adobe RGB if there
/// is no profile (DCF 2.0).
fn jpeg(mut input: impl BufRead + Seek) -> Option<Stated> {
    const APP1: u8 = 0xe1;
    const APP2: u8 = 0xe2;
    const SCAN: u8 = 0xda;
    const END: u8 = 0xd9;
    let mut parts: Vec<(u8, Vec<u8>)> = Vec::new();
    let (mut count, mut bytes_of_parts, mut is_adobe_rgb) = (0, 0, false);
    loop {
        let [mut marker] = bytes::<1>(&mut input)?;
        if marker != 0xff {
            continue;
        }
        while marker == 0xff {
            [marker] = bytes(&mut input)?;
        }
        match marker {
            SCAN | END => break,
            // Bytes that are no marker, and markers without a length.
            0 | 1 | 0xd0..=0xd8 => continue,
            _ => {}
        }
        let length = u64::from(u16::from_be_bytes(bytes(&mut input)?)).checked_sub(2)?;
        if !matches!(marker, APP1 | APP2) || length < 14 {
            input.seek_relative(length as i64).ok()?;
            continue;
        }
        let segment = data(&mut input, length)?;
        if let Some(fields) = segment.strip_prefix(b"Exif\0\0") {
            is_adobe_rgb |= states_adobe_rgb(fields);
        } else if let Some([number, of, part @ ..]) = segment.strip_prefix(PART) {
            parts.push((*number, part.to_vec()));
            count = usize::from(*of);
            bytes_of_parts += part.len() as u64;
            if bytes_of_parts > MAX_PROFILE {
                return Some(Stated::DamagedProfile);
            }
        }
    }
    if parts.is_empty() {
        return is_adobe_rgb.then_some(Stated::AdobeRgb);
    }
    parts.sort_by_key(|(number, _)| *number);
    let is_complete = parts.len() == count
        && parts.iter().zip(1..).all(|((number, _), expected)| usize::from(*number) == expected);
    let profile = parts.into_iter().flat_map(|(_, part)| part).collect();
    Some(if is_complete { Stated::Profile(profile) } else { Stated::DamagedProfile })
}

/// Returns true if EXIF names the colours that DCF 2.0 calls R03.
fn states_adobe_rgb(fields: &[u8]) -> bool {
    let fields = exif::Reader::new().read_raw(fields.to_vec()).ok();
    let index = |fields: exif::Exif| {
        let field = fields.get_field(Tag::InteroperabilityIndex, In::PRIMARY)?;
        Some(matches!(&field.value, Value::Ascii(texts) if texts.iter().any(|text| text == b"R03")))
    };
    fields.and_then(index).unwrap_or(false)
}

/// The chunk `ICCP` precedes the pixels.
fn webp(mut input: impl BufRead + Seek) -> Option<Stated> {
    loop {
        let [kind @ .., a, b, c, d] = bytes::<8>(&mut input)?;
        let length = u64::from(u32::from_le_bytes([a, b, c, d]));
        match &kind {
            b"ICCP" if length > MAX_PROFILE => return Some(Stated::DamagedProfile),
            b"ICCP" => return Some(Stated::Profile(data(&mut input, length)?)),
            b"VP8 " | b"VP8L" | b"ANMF" | b"ALPH" => return None,
            _ => {}
        }
        // Chunks have even lengths in the file.
        input.seek_relative((length + length % 2) as i64).ok()?;
    }
}
