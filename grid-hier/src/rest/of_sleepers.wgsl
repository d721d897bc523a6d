// What marks the mass that G2P finds beside a particle's block, which it reads anyway, if the block sleeps.
const OF_SLEEPERS: u32 = 0x80000000u;
