//! The memory of this process, as the system measures it.

/// The resident memory of this process `[bytes]`; `None` if unknown.
pub fn resident() -> Option<u64> {
    status_line("VmRSS:")
}

/// The peak resident memory of this process `[bytes]`; `None` if unknown.
pub fn peak_resident() -> Option<u64> {
    status_line("VmHWM:")
}

/// The value of a line of `/proc/self/status` `[bytes]`; `None` if there is no such line.
pub fn status_line(key: &str) -> Option<u64> {
    parse_status(&std::fs::read_to_string("/proc/self/status").ok()?, key)
}

/// The value of a line in the text of `/proc/<pid>/status` `[bytes]`, such as "VmRSS:     1234 kB" (proc(5): kB means
/// 1,024 bytes).
pub fn parse_status(status: &str, key: &str) -> Option<u64> {
    let value = status.lines().find_map(|line| line.strip_prefix(key))?;
    let kibibytes: u64 = value.trim().strip_suffix("kB")?.trim().parse().ok()?;
    kibibytes.checked_mul(1024)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn status_lines_are_parsed() {
        let status = "Name:\tx\nVmHWM:\t   2048 kB\nVmRSS:\t     10 kB\n";
        assert_eq!(parse_status(status, "VmHWM:"), Some(2 << 20));
        assert_eq!(parse_status(status, "VmRSS:"), Some(10 << 10));
        assert_eq!(parse_status(status, "VmPeak:"), None);
        assert_eq!(parse_status("VmHWM: many kB", "VmHWM:"), None);
        if let (Some(now), Some(peak)) = (resident(), peak_resident()) {
            assert!(now > 0 && peak > 0);
        }
    }
}
