// The layout of a gradient record: nine numbers for training, then optional ones for the requested
// signals. policies/src/signals.rs has the table.

// Numbers per record, and how many of them training needs.
override RECORD: u32;
const BASE: u32 = 9u;
// Indices of the optional numbers; 0 if records do not have them.
override ABS_X_AT: u32;
override ABS_Y_AT: u32;
override WEIGHT_SUM_AT: u32;
override PIXEL_COUNT_AT: u32;
override DEPTH_AT: u32;
override ERROR_AT: u32;
// This field is a maximum; the others are sums.
override WEIGHT_MAX_AT: u32;

// After project_bwd.wgsl, a row's splat is the derivatives with respect to: mean, log-scale x | log-scale y, z, quaternion
// w, x | quaternion y, z, logit, projected mean x. Its sums are, in this order: the view direction, the derivative with
// respect to the projected mean's y, a bit per channel whose colour is above its clamp at 0 (as a number), the splat's
// l1; the others, from the colour on, stay sums.
const DIRECTION_AT: u32 = 0u;
const MEAN_Y_AT: u32 = 3u;
const UNCLAMPED_AT: u32 = 4u;
const L1_AT: u32 = 5u;
const COLOUR_AT: u32 = 6u;
