//! What the system says of this process.

/// A line of `/proc/self/status` `[bytes]`, where the system has one (proc(5): kB means 1,024 bytes).
pub(crate) fn status(key: &str) -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix(key))?;
    line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()?.checked_mul(1024)
}
