#include "neighbours.h"

#include <algorithm>
#include <limits>
#include <vector>

#include "thread_pool.h"

namespace evsplat {
namespace {

constexpr size_t kLeaf = 16;

struct Point {
    float x[3];
    uint32_t index;
};

// A node splits [begin, end) of the points at `middle`: those below are not above `split` along `axis`,
// the others not below it. A leaf has no axis. The children of node i are 2 i + 1 and 2 i + 2.
struct Node {
    size_t begin, middle, end;
    int axis;
    float split;
};

class Tree {
  public:
    Tree(const float* points, size_t count) : points_(count) {
        for (size_t i = 0; i < count; ++i)
            points_[i] = {{points[3 * i], points[3 * i + 1], points[3 * i + 2]}, uint32_t(i)};
        size_t nodes = 1;
        for (size_t most = count; most > kLeaf; most -= most / 2) nodes = 2 * nodes + 1;
        nodes_.resize(nodes);
        build(0, 0, count);
    }

    const std::vector<Point>& points() const { return points_; }

    // The k nearest of `x`, but not the one at `without`, nearest first.
    void search(const float* x, size_t without, int k, float* square, int64_t* index) const {
        std::fill_n(square, k, std::numeric_limits<float>::infinity());
        std::fill_n(index, k, 0);
        const float beyond[3] = {};
        visit(0, {x, without, k, square, index}, beyond);
    }

  private:
    struct Search {
        const float* x;
        size_t without;
        int k;
        float* square;
        int64_t* index;
    };

    void build(size_t node, size_t begin, size_t end) {
        Node& here = nodes_[node];
        here = {begin, end, end, -1, 0.f};
        if (end - begin <= kLeaf) return;
        float low[3], high[3];
        for (int a = 0; a < 3; ++a) low[a] = high[a] = points_[begin].x[a];
        for (size_t i = begin; i < end; ++i)
            for (int a = 0; a < 3; ++a)
                low[a] = std::min(low[a], points_[i].x[a]), high[a] = std::max(high[a], points_[i].x[a]);
        int axis = 0;
        for (int a = 1; a < 3; ++a)
            if (high[a] - low[a] > high[axis] - low[axis]) axis = a;
        const size_t middle = begin + (end - begin) / 2;
        std::nth_element(points_.begin() + begin, points_.begin() + middle, points_.begin() + end,
                         [axis](const Point& a, const Point& b) { return a.x[axis] < b.x[axis]; });
        here = {begin, middle, end, axis, points_[middle].x[axis]};
        build(2 * node + 1, begin, middle);
        build(2 * node + 2, middle, end);
    }

    // `beyond`: how far the node's box surely lies from the point along each axis.
    void visit(size_t node, const Search& s, const float (&beyond)[3]) const {
        const Node& here = nodes_[node];
        const float* x = s.x;
        if (here.axis < 0) {
            for (size_t i = here.begin; i < here.end; ++i) {
                const float dx = points_[i].x[0] - x[0], dy = points_[i].x[1] - x[1], dz = points_[i].x[2] - x[2];
                const float distance = dx * dx + dy * dy + dz * dz;
                if (distance >= s.square[s.k - 1] || i == s.without) continue;
                int place = s.k - 1;
                for (; place && s.square[place - 1] > distance; --place)
                    s.square[place] = s.square[place - 1], s.index[place] = s.index[place - 1];
                s.square[place] = distance, s.index[place] = points_[i].index;
            }
            return;
        }
        const float across = here.split - x[here.axis];
        const size_t near = 2 * node + (across > 0.f ? 1 : 2), far = 4 * node + 3 - near;
        visit(near, s, beyond);
        float farther[3] = {beyond[0], beyond[1], beyond[2]};
        farther[here.axis] = across;
        const float least = farther[0] * farther[0] + farther[1] * farther[1] + farther[2] * farther[2];
        if (least < s.square[s.k - 1]) visit(far, s, farther);
    }

    std::vector<Point> points_;
    std::vector<Node> nodes_;
};

}  // namespace

void find_neighbours(const Neighbours& job, int threads) {
    constexpr size_t kPiece = 1024;
    const Tree tree(job.points, job.count);
    const size_t count = job.queries ? job.query_count : job.count;
    parallel_for(threads, (count + kPiece - 1) / kPiece, [&](size_t piece) {
        for (size_t i = piece * kPiece; i < std::min(count, (piece + 1) * kPiece); ++i) {
            // The points themselves are taken in the tree's order, which keeps its nodes in the cache.
            const size_t row = job.queries ? i : tree.points()[i].index;
            const float* x = job.queries ? job.queries + 3 * i : tree.points()[i].x;
            const size_t without = job.queries ? job.count : i;
            tree.search(x, without, job.k, job.square + row * job.k, job.index + row * job.k);
        }
    });
}

}  // namespace evsplat
