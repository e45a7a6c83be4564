// Copyright (C) 2026 the mpm-dolfinx authors
// SPDX-License-Identifier: LGPL-3.0-or-later

#pragma once

// A loop that is compiled for processors with and without AVX2; the loader picks one, unless all is
// compiled for those with it. ("avx2" asks what the processor can do, where the name of one asks for
// that very model. Without fused multiplication and addition both round alike, so that results do
// not go with the processor.) A part of loops is compiled once for all that call it: inlined
// everywhere, large ones take compilers several times as long, and run no faster.
#if defined(__AVX2__) && defined(__GNUC__) && !defined(__clang__)
#define HOT_LOOP __attribute__((flatten))
#define HOT_PART __attribute__((flatten, noinline))
#elif defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__)
#define HOT_LOOP __attribute__((target_clones("avx2", "default"), flatten))
#define HOT_PART __attribute__((target_clones("avx2", "default"), flatten, noinline))
#else
#define HOT_LOOP
#define HOT_PART
#endif
