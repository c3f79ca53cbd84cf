// The page of a file's point clouds begins.

window.page = new PointsPage(JSON.parse($("header").textContent));
window.page.start();
