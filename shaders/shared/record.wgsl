// The layout of a gradient record: nine numbers for training, then optional ones for the requested
// signals. policies/src/signals.rs has the table.

// Numbers per record.
override RECORD: u32;
// Indices of the optional numbers; 0 if records do not have them.
override ABS_X_AT: u32;
override ABS_Y_AT: u32;
override WEIGHT_SUM_AT: u32;
override PIXEL_COUNT_AT: u32;
override DEPTH_AT: u32;
override ERROR_AT: u32;
// This field is a maximum; the others are sums.
override WEIGHT_MAX_AT: u32;
