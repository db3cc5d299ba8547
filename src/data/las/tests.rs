//! Tests of the reader of LAS and LAZ files. The crate writes the LAZ files, LASzip and lazperf those of the corpus.

use std::io::Cursor;

use laz::{LasZipCompressor, LazItemRecordBuilder, LazVlr, LazVlrBuilder};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::compression::LENGTHS;
use super::*;

/// Length of the head of a variable-length record `[bytes]`.
const HEAD: usize = 54;

/// How a LAZ file is divided into chunks.
#[derive(Debug, Clone, Copy)]
enum Chunks {
    Equal(u32),
    Listed(&'static [usize]),
}
use Chunks::{Equal, Listed};

/// Records of a format. All fields change now and then; the times are those of three lasers.
fn scan(format: u8, extra: u16, count: usize) -> Vec<Vec<u8>> {
    let mut draws = ChaCha8Rng::seed_from_u64(format.into());
    let mut record = vec![0; usize::from(LENGTHS[usize::from(format)] + extra)];
    let mut place = [0_i32; 3];
    let mut time = 1e8;
    let mut next = || {
        for byte in &mut record[12..] {
            if draws.random_bool(0.1) {
                *byte = draws.random();
            }
        }
        for (axis, bytes) in place.iter_mut().zip(record.as_chunks_mut().0) {
            *axis += draws.random_range(-300..300);
            *bytes = axis.to_le_bytes();
        }
        time += [0.0, 1e-5, 1e-5, 1e-5, -1e-5, 1e-4, 1.0][draws.random_range(0..7)];
        let time = time + [0.0, 0.0, 0.0, 1e4, 2e4][draws.random_range(0..5)];
        match format {
            0 | 2 => {}
            1..6 => record[20..28].copy_from_slice(&f64::to_le_bytes(time)),
            _ => record[22..30].copy_from_slice(&f64::to_le_bytes(time)),
        }
        record.clone()
    };
    (0..count).map(|_| next()).collect()
}

/// The header of a file, with a variable-length record unless that is empty. The formats from 6 on have version 1.4.
fn header(format: u8, records: &[Vec<u8>], extra: &[u8]) -> Vec<u8> {
    let length = if format < 6 { HEADER } else { LONG_HEADER };
    let mut bytes = vec![0; length];
    let mut set = |at: usize, value: &[u8]| bytes[at..at + value.len()].copy_from_slice(value);
    set(0, MAGIC);
    set(94, &(length as u16).to_le_bytes());
    set(96, &((length + extra.len()) as u32).to_le_bytes());
    set(100, &u32::from(!extra.is_empty()).to_le_bytes());
    set(104, &[format]);
    set(105, &(records[0].len() as u16).to_le_bytes());
    match format {
        ..6 => set(107, &(records.len() as u32).to_le_bytes()),
        _ => set(247, &(records.len() as u64).to_le_bytes()),
    }
    for axis in 0..3 {
        set(131 + 8 * axis, &0.01_f64.to_le_bytes());
        set(155 + 8 * axis, &1000.0_f64.to_le_bytes());
    }
    bytes.extend(extra);
    bytes
}

fn las(format: u8, records: &[Vec<u8>]) -> Vec<u8> {
    [header(format, records, &[]), records.concat()].concat()
}

/// A LAZ file whose points are divided and compressed as the contents of the record of LASzip say.
fn laz_with(format: u8, records: &[Vec<u8>], chunks: Chunks, vlr: LazVlr) -> Vec<u8> {
    let mut extra = vec![0; HEAD];
    extra[2..16].copy_from_slice(LazVlr::USER_ID.as_bytes());
    extra[18..20].copy_from_slice(&LazVlr::RECORD_ID.to_le_bytes());
    vlr.write_to(&mut extra).unwrap();
    let length = (extra.len() - HEAD) as u16;
    extra[20..22].copy_from_slice(&length.to_le_bytes());
    let mut file = Cursor::new(header(format, records, &extra));
    file.get_mut()[104] |= 0x80;
    file.seek(SeekFrom::End(0)).unwrap();
    let mut compressor = LasZipCompressor::new(file, vlr).unwrap();
    match chunks {
        Equal(_) => compressor.compress_many(&records.concat()).unwrap(),
        Listed(lengths) => {
            let mut rest = records;
            let mut take = |length| rest.split_off(..length).unwrap().concat();
            compressor.compress_chunks(lengths.iter().map(|&length| take(length))).unwrap();
        }
    }
    compressor.done().unwrap();
    compressor.into_inner().into_inner()
}

fn laz(format: u8, records: &[Vec<u8>], chunks: Chunks) -> Vec<u8> {
    let extra = records[0].len() as u16 - LENGTHS[usize::from(format)];
    let vlr = LazVlrBuilder::default().with_point_format(format, extra).unwrap();
    let vlr = match chunks {
        Equal(size) => vlr.with_fixed_chunk_size(size),
        Listed(_) => vlr.with_variable_chunk_size(),
    };
    laz_with(format, records, chunks, vlr.build())
}

fn read_bytes(bytes: &[u8]) -> Result<PointCloud, String> {
    read_from(Path::new("scan.laz"), Cursor::new(bytes)).map_err(|error| error.to_string())
}

/// A file of format 2 with two points, of which the second has this colour.
fn pair(colour: u16) -> Vec<u8> {
    let record = |(place, colour): ([i32; 3], u16)| {
        let mut record = vec![0; 26];
        record[..12].copy_from_slice(bytemuck::bytes_of(&place.map(i32::to_le)));
        record[20..].copy_from_slice(bytemuck::bytes_of(&[colour, 0, 1].map(u16::to_le)));
        record
    };
    las(2, &[([0, 0, 0], 0), ([100, -200, 300], colour)].map(record))
}

#[test]
fn points_and_colours_of_either_depth_are_read() {
    let points = read_bytes(&pair(200)).unwrap();
    assert_eq!(points.positions, [DVec3::splat(1000.0), DVec3::new(1001.0, 998.0, 1003.0)]);
    assert_eq!(points.colours, [[0, 0, 1], [200, 0, 1]]);
    assert_eq!(read_bytes(&pair(0x8000)).unwrap().colours[1], [128, 0, 0]);
}

#[test]
fn damaged_files_are_refused() {
    let with = |edit: &dyn Fn(&mut Vec<u8>)| {
        let mut bytes = pair(0);
        edit(&mut bytes);
        read_bytes(&bytes).unwrap_err()
    };
    assert!(with(&|bytes| bytes.truncate(250)).contains("of 279 bytes"));
    assert!(with(&|bytes| bytes[110] = 0xff).contains("not supported"));
    assert!(with(&|bytes| bytes[0] = 0).contains("not that of a LAS"));
    assert!(with(&|bytes| bytes.truncate(9)).contains("not that of a LAS"));
}

#[test]
fn compressed_points_are_those_of_the_same_file_without_compression() {
    for format in 0..=10 {
        for extra in [0, 3] {
            let records = scan(format, extra, 200);
            let expected = read_bytes(&las(format, &records)).unwrap();
            assert_eq!(expected.len(), 200);
            for chunks in [Equal(1000), Equal(200), Equal(64), Listed(&[70, 1, 129])] {
                let points = read_bytes(&laz(format, &records, chunks)).unwrap();
                assert!(points == expected, "format {format}, {extra} extra bytes, {chunks:?}");
            }
        }
    }
}

/// Version 4 of the items differs when the channel of the scanner changes.
#[test]
fn both_versions_of_layers_are_read() {
    let records = scan(7, 0, 200);
    let items = LazItemRecordBuilder::version_4_of::<laz::las::Point7>(0);
    let vlr = LazVlrBuilder::new(items).with_fixed_chunk_size(64).build();
    let file = laz_with(7, &records, Equal(64), vlr);
    assert_eq!(read_bytes(&file).unwrap(), read_bytes(&las(7, &records)).unwrap());
}

/// A program that writes to a pipe cannot go back to fill in the place of the table.
#[test]
fn the_place_of_the_table_may_be_at_the_end() {
    let records = scan(3, 0, 200);
    let mut file = laz(3, &records, Equal(64));
    let begin = HEADER + HEAD + 34 + 3 * 6;
    let place: [u8; 8] = file[begin..begin + 8].try_into().unwrap();
    file[begin..begin + 8].fill(0xff);
    assert!(read_bytes(&file).unwrap_err().contains("the table of chunks: its place is"));
    file.extend(place);
    assert_eq!(read_bytes(&file).unwrap(), read_bytes(&las(3, &records)).unwrap());
}

#[test]
fn files_of_other_programs_are_read() {
    let read_file = |name: &str| read(&densify_fixtures::corpus("las").join(name)).unwrap();
    for (file, packed) in [
        ("format3.las", "format3_laszip.laz"),
        ("format7.las", "format7_laszip.laz"),
        ("format7.las", "format7_lazperf.laz"),
    ] {
        let points = read_file(file);
        assert_eq!(points.len(), 12);
        assert!(points.colours[0] != points.colours[1]);
        assert_eq!(read_file(packed), points, "{packed}");
    }
}

#[test]
fn damaged_compressed_files_are_refused() {
    const VLR: usize = LONG_HEADER + HEAD;
    const BEGIN: usize = VLR + 34 + 2 * 6;
    const CHUNK: usize = BEGIN + 8;
    /// The lengths of the layers follow the first record and the number of points.
    const LAYERS: usize = CHUNK + 36 + 4;
    fn set(file: &mut [u8], at: usize, value: &[u8]) {
        file[at..at + value.len()].copy_from_slice(value);
    }
    fn table(file: &[u8]) -> usize {
        u64::from_le_bytes(file[BEGIN..CHUNK].try_into().unwrap()) as usize
    }
    fn set_in_table(file: &mut [u8], at: usize, value: &[u8]) {
        set(file, table(file) + at, value);
    }
    type Case = (fn(&mut Vec<u8>), &'static str);
    let cases: &[Case] = &[
        (|file| file.truncate(BEGIN + 3), "the table of chunks: it is cut off"),
        (|file| file.truncate(CHUNK + 99), "the table of chunks: its place is"),
        (|file| file.truncate(table(file) + 7), "the table of chunks: it is cut off"),
        (|file| set(file, BEGIN, &[0; 8]), "the table of chunks: its place is 0"),
        (|file| set(file, BEGIN, &[0xfe; 8]), "the table of chunks: its place is 18"),
        // The crate would take 64 GiB.
        (|file| set_in_table(file, 4, &[0xff; 4]), "4294967295 chunks do not"),
        (
            |file| set_in_table(file, 4, &[3]),
            "the table of chunks: it contradicts the number of points in the header, 200",
        ),
        (|file| set_in_table(file, 8, &[0xff; 4]), "an impossible number"),
        (
            |file| set(file, 247, &[1, 1]),
            "the table of chunks: it contradicts the number of points in the header, 257",
        ),
        // The crate would take 2 GiB.
        (
            |file| set(file, LAYERS + 4, &[0xff, 0xff, 0xff, 0x7f]),
            "chunk 1 of 4: its layers do not fit",
        ),
        (|file| set(file, LAYERS + 40, &[0xff; 4]), "chunk 1 of 4: it begins with an impossible"),
        (|file| set(file, LAYERS, &[0]), "chunk 1 of 4: it is cut off"),
        (|file| set(file, LONG_HEADER + 2, b"laszip decoded"), "of LASzip: there is none"),
        (|file| set(file, LONG_HEADER + 18, &[0]), "of LASzip: there is none"),
        (|file| set(file, 100, &[0]), "of LASzip: there is none"),
        (|file| set(file, 94, &[0xff, 0xff]), "of LASzip: there is none"),
        (|file| set(file, LONG_HEADER + 20, &[3]), "of LASzip: it is cut off"),
        (|file| set(file, LONG_HEADER + 20, &[33]), "of LASzip: it is cut off"),
        (|file| set(file, VLR, &[0]), "compressor 0 (none) with coder 0 is not supported; unpack"),
        (
            |file| set(file, VLR, &[1]),
            "compressor 1 (without chunks) with coder 0 is not supported",
        ),
        (|file| set(file, VLR, &[4]), "compressor 4 with coder 0 is not supported; unpack"),
        (|file| set(file, VLR + 2, &[1]), "compressor 3 with coder 1 is not supported; unpack"),
        (|file| set(file, VLR, &[2]), "it contradicts the header"),
        (|file| set(file, VLR + 32, &[0]), "it contradicts the header"),
        (|file| set(file, VLR + 32, &[1]), "it contradicts the header"),
        (|file| set(file, VLR + 34, &[99]), "of LASzip: Item with type code: 99"),
        (|file| set(file, VLR + 36, &[29]), "it contradicts the header"),
        (|file| set(file, VLR + 38, &[2]), "version 2 of Point14 is not supported; unpack"),
        (|file| set(file, 104, &[0x80 | 8]), "point format 8 with 36 bytes"),
        (|file| set(file, 104, &[0x80 | 11]), "point format 11 with 36 bytes"),
        (|file| set(file, 105, &[37]), "point format 7 with 37 bytes"),
    ];
    let file = laz(7, &scan(7, 0, 200), Equal(64));
    for (index, (edit, expected)) in cases.iter().enumerate() {
        let mut damaged = file.clone();
        edit(&mut damaged);
        let message = read_bytes(&damaged).err().unwrap_or_else(|| panic!("{index} is accepted"));
        assert!(
            message.starts_with("scan.laz: ") && message.contains(expected),
            "{index}: {message}"
        );
    }

    let mut file = laz(1, &scan(1, 0, 200), Listed(&[200]));
    let begin = HEADER + HEAD + 34 + 2 * 6;
    set(&mut file, 107, &[199]);
    assert!(
        read_bytes(&file)
            .unwrap_err()
            .contains("it contradicts the number of points in the header, 199")
    );
    set(&mut file, 107, &[200]);
    set(&mut file, begin + 8 + 28, &[0xff; 4]);
    let message = read_bytes(&file).unwrap_err();
    assert!(message.contains("chunk 1 of 2: it begins with an impossible number"), "{message}");
    let file = laz(0, &scan(0, 2000, 2), Equal(64));
    assert!(read_bytes(&file).unwrap_err().contains("2000 extra bytes per point are not"));
}

#[test]
fn random_damage_causes_no_panic() {
    let mut draws = ChaCha8Rng::seed_from_u64(1);
    let mut accepted = 0;
    for format in [1, 3, 5, 6, 7, 10] {
        let records = scan(format, 1, 30);
        let file =
            laz(format, &records, if format % 2 == 0 { Equal(20) } else { Listed(&[5, 25]) });
        for _ in 0..500 {
            let mut damaged = file.clone();
            for _ in 0..draws.random_range(1..4) {
                let at = draws.random_range(0..damaged.len());
                let length = draws.random_range(1..6).min(damaged.len() - at);
                match draws.random_range(0..4) {
                    0 => damaged[at] ^= 1 << draws.random_range(0..8),
                    1 => damaged[at] = draws.random(),
                    2 => damaged[at..at + length].fill(0xff),
                    _ => damaged[at..at + length].fill(0),
                }
            }
            let Ok(points) = read_bytes(&damaged) else { continue };
            assert_eq!(points.colours.len(), points.positions.len());
            accepted += 1;
        }
    }
    // Damage to a code mostly yields other points.
    assert!(accepted > 300, "{accepted}");
}
