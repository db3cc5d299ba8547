//! Parses and formats numbers for people: `28k`, `1.5M`, `1GiB`; 28,000; 2 min 5 s.

use std::fmt::Display;
use std::str::FromStr;
use std::time::Duration;

use serde::de::Error as _;
use serde::{Deserialize, Deserializer};
use serde_json::Value;

/// The maximum number of rows that 32-bit row numbers can address.
const MAX_ROWS: f64 = u32::MAX as f64;

/// Parses a number of Gaussians: `200000`, `28k`, `1.5M`.
///
/// # Errors
/// A message with the accepted spellings.
pub fn rows(text: &str) -> Result<usize, String> {
    let wrong =
        || format!("`{text}` is not a number of Gaussians; write it as 200000, 200k or 1.5M");
    let (number, factor) = match text.char_indices().last() {
        Some((at, 'k' | 'K')) => (&text[..at], 1e3),
        Some((at, 'm' | 'M')) => (&text[..at], 1e6),
        _ => (text, 1.0),
    };
    let number = number.replace('_', "");
    if !number.starts_with(|c: char| c.is_ascii_digit()) {
        return Err(wrong());
    }
    let rows: f64 = number.parse::<f64>().map_err(|_| wrong())? * factor;
    // 1.1M is not exactly 1,100,000 in binary.
    let whole = rows.round();
    if !rows.is_finite() || (rows - whole).abs() > 1e-6 * factor {
        return Err(wrong());
    }
    if !(1.0..=MAX_ROWS).contains(&whole) {
        return Err(format!(
            "`{text}` is out of range; a model has at least 1 and at most 4 billion Gaussians"
        ));
    }
    Ok(whole as usize)
}

/// Parses a number of bytes: `1GiB`, `512MiB`, `800MB`, `1000000`.
///
/// # Errors
/// A message with the accepted spellings.
pub fn bytes(text: &str) -> Result<u64, String> {
    const UNITS: [(&str, f64); 10] = [
        ("KiB", 1024.0),
        ("MiB", 1024.0 * 1024.0),
        ("GiB", 1024.0 * 1024.0 * 1024.0),
        ("TiB", 1024.0 * 1024.0 * 1024.0 * 1024.0),
        ("kB", 1e3),
        ("KB", 1e3),
        ("MB", 1e6),
        ("GB", 1e9),
        ("TB", 1e12),
        ("B", 1.0),
    ];
    let wrong =
        || format!("`{text}` is not a number of bytes; write it as 1GiB, 512MiB, 800MB or 1000000");
    let unit = UNITS.iter().find_map(|(unit, factor)| Some((text.strip_suffix(unit)?, *factor)));
    let (number, factor) = unit.unwrap_or((text, 1.0));
    let number = number.trim();
    if !number.starts_with(|c: char| c.is_ascii_digit()) {
        return Err(wrong());
    }
    let bytes = number.parse::<f64>().map_err(|_| wrong())? * factor;
    // More than 2⁵³ bytes must be a typing error.
    if !(0.0..=9e15).contains(&bytes) {
        return Err(wrong());
    }
    Ok(bytes as u64)
}

/// Parses a fraction above 0 and below 1.
///
/// # Errors
/// A message with the range.
pub fn fraction(text: &str) -> Result<f64, String> {
    let value: f64 = text.parse().map_err(|_| format!("`{text}` is not a number"))?;
    if value > 0.0 && value < 1.0 {
        Ok(value)
    } else {
        Err(format!("`{text}` is out of range; it must be greater than 0 and less than 1"))
    }
}

/// Formats a fraction as a percentage; a non-finite one as a dash.
pub fn percent(value: f64) -> String {
    if value.is_finite() { format!("{:.3} %", 100.0 * value) } else { "–".into() }
}

/// Formats a number of Gaussians: `1 Gaussian`, `2,000 Gaussians`.
pub fn gaussians(number: usize) -> String {
    counted(number, "Gaussian")
}

/// Formats a number of things: `1 trial`, `2,000 trials`.
pub fn counted(number: usize, thing: &str) -> String {
    format!("{} {thing}{}", grouped(number), if number == 1 { "" } else { "s" })
}

/// Formats 1234567 as 1,234,567.
pub fn grouped(number: usize) -> String {
    let digits = number.to_string();
    let mut shown = String::with_capacity(digits.len() + digits.len() / 3);
    for (place, digit) in digits.chars().enumerate() {
        if place > 0 && (digits.len() - place).is_multiple_of(3) {
            shown.push(',');
        }
        shown.push(digit);
    }
    shown
}

/// Formats a duration: 4.2 s, 45 s, 2 min 5 s, 3 h 0 min.
pub fn duration(time: Duration) -> String {
    let seconds = time.as_secs_f64().round() as u64;
    match (seconds / 3600, seconds / 60 % 60, seconds % 60) {
        (0, 0, _) if time.as_secs_f64() < 9.95 => format!("{:.1} s", time.as_secs_f64()),
        (0, 0, s) => format!("{s} s"),
        (0, m, s) => format!("{m} min {s} s"),
        (h, m, _) => format!("{h} h {m} min"),
    }
}

/// Deserialises a number or a string by the type's `FromStr`, as the command line does.
///
/// # Errors
/// The errors of `FromStr`.
pub fn number_or_text<'de, D, T>(deserializer: D) -> Result<T, D::Error>
where
    D: Deserializer<'de>,
    T: FromStr<Err: Display>,
{
    let text = match Value::deserialize(deserializer)? {
        Value::String(text) => text,
        other => other.to_string(),
    };
    text.parse().map_err(D::Error::custom)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_are_parsed_in_every_spelling() {
        let good = [
            ("1", 1),
            ("200000", 200_000),
            ("200_000", 200_000),
            ("28k", 28_000),
            ("28K", 28_000),
            ("1.5M", 1_500_000),
            ("1.1M", 1_100_000),
            ("0.5k", 500),
            ("4294967295", u32::MAX as usize),
        ];
        for (text, number) in good {
            assert_eq!(rows(text), Ok(number), "{text}");
        }
        for text in ["", "k", "-1", "+5", "0.5", "1.0001k5", "28 k", "28kk", "inf", "NaN", "1e3é"]
        {
            assert!(rows(text).unwrap_err().contains("200k"), "{text}");
        }
        for text in ["0", "0k", "4294967296", "1e30", "5000M"] {
            assert!(rows(text).unwrap_err().contains("out of range"), "{text}");
        }
    }

    #[test]
    fn bytes_are_parsed_in_every_spelling() {
        let good = [
            ("0", 0),
            ("1000000", 1_000_000),
            ("1GiB", 1 << 30),
            ("0.5 KiB", 512),
            ("512MiB", 512 << 20),
            ("800MB", 800_000_000),
            ("5KB", 5_000),
            ("5kB", 5_000),
            ("12 B", 12),
        ];
        for (text, number) in good {
            assert_eq!(bytes(text), Ok(number), "{text}");
        }
        for text in ["", "GiB", "-1", "1G", "1Gib", "1MiBB", "B", "1e300GiB", "NaN", "much"] {
            assert!(bytes(text).unwrap_err().contains("1GiB"), "{text}");
        }
    }

    #[test]
    fn fractions_exclude_0_and_1() {
        assert_eq!(fraction("0.01"), Ok(0.01));
        for text in ["0", "1", "-0.1", "NaN", "x"] {
            assert!(fraction(text).is_err(), "{text}");
        }
    }

    #[test]
    fn numbers_and_durations_are_formatted() {
        assert_eq!([0, 999, 1_000, 1_234_567].map(grouped), ["0", "999", "1,000", "1,234,567"]);
        let shown = |seconds| duration(Duration::from_secs_f64(seconds));
        assert_eq!(
            [0.04, 9.94, 9.96, 59.4, 59.6, 125.0, 10_800.0].map(shown),
            ["0.0 s", "9.9 s", "10 s", "59 s", "1 min 0 s", "2 min 5 s", "3 h 0 min"]
        );
    }
}
