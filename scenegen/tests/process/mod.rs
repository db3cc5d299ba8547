//! Memory of this process, as reported by the system.

/// An entry of `/proc/self/status` `[bytes]`, on systems that have it (proc(5): kB means 1,024 bytes).
pub(crate) fn status(key: &str) -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix(key))?;
    line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()?.checked_mul(1024)
}
