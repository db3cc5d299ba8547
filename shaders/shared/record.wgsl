// The layout of a gradient record: nine numbers that training needs, then the optional ones that the
// requested signals need. src/backend/signals.rs has the table.

// Numbers per record.
override RECORD: u32;
// Places of the optional numbers; 0 where records do not have them.
override ABS_X_AT: u32;
override ABS_Y_AT: u32;
override WEIGHT_SUM_AT: u32;
override PIXEL_COUNT_AT: u32;
override DEPTH_AT: u32;
override ERROR_AT: u32;
// The largest of its values; all others are sums.
override WEIGHT_MAX_AT: u32;
