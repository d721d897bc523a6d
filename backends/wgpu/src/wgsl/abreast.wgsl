// A workgroup works on ABREAST blocks at once, 64 threads each; which of them is this thread's.
var<private> abreast: u32;
