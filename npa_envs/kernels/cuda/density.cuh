// Lists of neighbours: the density pass makes them in fast memory and leaves them for perception.

namespace npa {

// Each thread's entries lie a block's width apart; ROOM: entries that a thread has room for.
template <int ROOM, int BLOCK> __device__ inline unsigned list_address()
{
    __shared__ unsigned short lists[ROOM * BLOCK];
    return (unsigned)__cvta_generic_to_shared(lists + threadIdx.x);
}

// As assembly, so that loads of global memory may be moved ahead of it, and without branches.
template <int ROOM, int BLOCK>
__device__ inline unsigned append_step(unsigned first, unsigned place, float weight, int step)
{
    asm volatile(
        "{ .reg .pred near, kept;\n"
        "setp.gt.f32 near, %1, 0f00000000;\n"
        "setp.lt.and.u32 kept, %0, %2, near;\n"
        "@kept st.shared.u16 [%0], %3;\n"
        "@near add.u32 %0, %0, %4; }"
        : "+r"(place)
        : "f"(weight), "r"(first + 2 * BLOCK * ROOM), "h"((short)step), "n"(2 * BLOCK));
    return place;
}

// Where a row's list begins: 32 rows lie together, first entries first.
template <int CAPACITY> __device__ inline size_t place_of_list(int row)
{
    return (size_t)(row / 32) * (32 * CAPACITY) + row % 32;
}

// Each lane's entries follow those of the lanes before it.
template <int ROOM, int BLOCK, int CAPACITY, int LANES>
__device__ inline int leave_list(
    unsigned first, unsigned place, int row, const wp::array_t<wp::int16>& lists)
{
    int length = (place - first) / (2 * BLOCK);
    if (length > ROOM) length = CAPACITY + 1;
    int end = length;
    #pragma unroll
    for (int offset = 1; offset < LANES; offset *= 2) {
        const int before = __shfl_up_sync(~0u, end, offset, LANES);
        if (threadIdx.x % LANES >= offset) end += before;
    }
    const int total = LANES > 1 ? __shfl_sync(~0u, end, LANES - 1, LANES) : length;
    if (row < 0 || total > CAPACITY) return total;
    short* to = lists.data + place_of_list<CAPACITY>(row);
    for (int entry = 0; entry < length; ++entry) {
        short step;
        asm volatile("ld.shared.u16 %0, [%1];" : "=h"(step) : "r"(first + 2 * BLOCK * entry));
        to[32 * (end - length + entry)] = step;
    }
    return total;
}

template <int CAPACITY>
__device__ inline int step_at(const wp::array_t<wp::int16>& lists, int row, int entry)
{
    return lists.data[place_of_list<CAPACITY>(row) + 32 * entry];
}

}  // namespace npa
