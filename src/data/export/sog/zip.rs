//! Writes a ZIP archive (PKWARE APPNOTE 6.3) whose files are stored as they are.

use std::io::{self, Write};

use flate2::Crc;

/// The date of all files, as MS-DOS writes 1 January 1980: equal models are equal files.
const DATE: u16 = 1 << 5 | 1;
/// Version 2.0, which any reader has.
const VERSION: u16 = 20;

/// An archive that is being written.
pub(super) struct Archive<'a> {
    out: &'a mut dyn Write,
    offset: u64,
    /// The table of contents.
    table: Vec<u8>,
    count: u16,
}

impl<'a> Archive<'a> {
    pub(super) fn new(out: &'a mut dyn Write) -> Self {
        Self { out, offset: 0, table: Vec::new(), count: 0 }
    }

    /// Writes a file.
    pub(super) fn add(&mut self, name: &str, bytes: &[u8]) -> io::Result<()> {
        let too_large = |_| {
            io::Error::new(
                io::ErrorKind::InvalidInput,
                "an archive has at most 4 GiB; choose another format, such as ply",
            )
        };
        let size = u32::try_from(bytes.len()).map_err(too_large)?;
        let offset = u32::try_from(self.offset).map_err(too_large)?;
        let mut sum = Crc::new();
        sum.update(bytes);
        let mut facts = Vec::new();
        // Flags, method, time, date.
        for half in [VERSION, 0, 0, 0, DATE] {
            facts.extend(half.to_le_bytes());
        }
        for word in [sum.sum(), size, size] {
            facts.extend(word.to_le_bytes());
        }
        facts.extend((name.len() as u16).to_le_bytes());
        // No extra field.
        facts.extend([0; 2]);
        let local = [b"PK\x03\x04", &facts[..], name.as_bytes()].concat();
        self.out.write_all(&local)?;
        self.out.write_all(bytes)?;
        self.table.extend(b"PK\x01\x02");
        self.table.extend(VERSION.to_le_bytes());
        self.table.extend(facts);
        // No comment, first disk, no attributes.
        self.table.extend([0; 10]);
        self.table.extend(offset.to_le_bytes());
        self.table.extend(name.as_bytes());
        self.offset += (local.len() + bytes.len()) as u64;
        self.count += 1;
        Ok(())
    }

    /// Writes the table of contents.
    pub(super) fn finish(self) -> io::Result<()> {
        let mut end = b"PK\x05\x06\0\0\0\0".to_vec();
        end.extend(self.count.to_le_bytes());
        end.extend(self.count.to_le_bytes());
        end.extend((self.table.len() as u32).to_le_bytes());
        end.extend((self.offset as u32).to_le_bytes());
        end.extend([0; 2]);
        self.out.write_all(&self.table)?;
        self.out.write_all(&end)
    }
}
