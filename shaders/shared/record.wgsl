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

// project_bwd.wgsl leaves derivatives in place of numbers that the rest of the step does not need. A row's splat then
// begins with those with respect to: mean, log-scale, quaternion w, x, y. Its sums begin with those with respect to:
// quaternion z, logit, projected mean. Then come a bit per channel whose colour is above its clamp at 0 (as a number), and
// the splat's l1. The other sums, from the colour on, remain.
const OF_SPLAT: u32 = 9u;
const LOGIT_AT: u32 = 1u;
const MEAN_2D_AT: u32 = 2u;
const UNCLAMPED_AT: u32 = 4u;
const L1_AT: u32 = 5u;
const COLOUR_AT: u32 = 6u;
