// The layout of a row's splat: projected mean, l1, shear, l3, log2 of the opacity, colour, depth. The depth is 0 for rows
// that are not on screen; they have no other numbers.

// Numbers per splat, and the index of the depth.
const SPLAT: u32 = 10u;
const DEPTH: u32 = 9u;
