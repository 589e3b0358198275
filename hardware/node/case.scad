// Case of a wall-mounted sensor node: two HC-SR04 behind slanted faces, a Wemos D1 mini on the wall plate.
//
// Printed without supports: the body on its upper side, the plate on its wall side, both with 0.2 mm layers.
// Parts to print: openscad -D 'part="body"' -o body.stl case.scad; likewise "plate", "bank" for the bay of a power bank.
// Axes in mm: x along the wall, y away from the wall, z up. The wall is at y = 0.

part = "assembly";       // "assembly", "body", "plate"

sonar_angle = 12.6;      // degrees by which each sonar looks to its side: `angle` = 0.22 rad in site.toml
power_bank = [0, 0, 0];  // width, depth and height of a power bank below the electronics; zeros: power by cable
wall = 2;                // thickness of all walls
gap = 0.4;               // play between printed parts

sonar_board = [45.5, 20.5, 1.6];  // an HC-SR04: width, height, thickness. Clones differ by a millimetre: measure yours
sonar_can = [16.4, 12.3];         // a transducer: diameter with play, height above the board
sonar_cans_apart = 26;            // between the middles of the two transducers
sonar_holes = [42.0, 17.0];       // between the mounting holes
can_proud = 2;                    // by which the transducers stand out of the face
mcu_board = [34.4, 25.8, 1.2];    // a D1 mini: length, width, thickness
cable = [11, 8];                  // the hole for the micro-USB plug's overmould: width, depth

face = sonar_board[0] + 2 * wall + 2;        // width of a slanted face
electronics_height = sonar_board[1] + 4;     // inside
has_bank = power_bank[0] > 0;
bay_height = has_bank ? power_bank[2] + 1 : 0;
height = electronics_height + 2 * wall + (has_bank ? bay_height + wall : 0);
half_width = max(face * cos(sonar_angle), has_bank ? power_bank[0] / 2 + wall + 1 : 0);
side_depth = max(34, has_bank ? power_bank[1] + 2 * wall + 2 : 0);   // at both ends; the middle stands out further
depth = side_depth + face * sin(sonar_angle);
floor_of_electronics = wall + (has_bank ? bay_height + wall : 0);
sonar_height = floor_of_electronics + electronics_height / 2;
$fn = 48;

module outline() {
    polygon([
        [-half_width, 0], [half_width, 0],
        [half_width, depth - half_width * tan(sonar_angle)], [0, depth],
        [-half_width, depth - half_width * tan(sonar_angle)],
    ]);
}

// Puts children on the outer side of the face of one sonar: x along the face, y out of it, the origin in its middle.
module at_face(side) {
    translate([0, depth, sonar_height]) rotate([0, 0, -side * sonar_angle]) translate([side * face / 2, 0, 0]) children();
}

module can_holes(side) {
    at_face(side) for (x = [-1, 1])
        translate([x * sonar_cans_apart / 2, 1, 0]) rotate([90, 0, 0]) cylinder(d = sonar_can[0], h = wall * 2 + 2);
}

// Four posts behind the face; the board is screwed onto them (M1.6 x 6, self-tapping) or held by a drop of hot glue.
module posts(side) {
    behind = sonar_can[1] - can_proud;       // from the outer side of the face to the board
    at_face(side) for (x = [-1, 1], z = [-1, 1]) translate([x * sonar_holes[0] / 2, 0, z * sonar_holes[1] / 2])
        rotate([90, 0, 0]) difference() {
            translate([0, 0, wall / 2]) cylinder(d = 4, h = behind - wall / 2);
            translate([0, 0, wall]) cylinder(d = 1.4, h = behind);
        }
}

module vents(side) {
    for (n = [0:3]) translate([side * half_width, 9 + 5 * n, sonar_height])
        cube([4 * wall, 2, electronics_height * 0.6], center = true);
}

// The screws that hold the plate (M3 x 8), in blocks in the body's corners.
module screw_places() {
    for (side = [-1, 1]) translate([side * (half_width - wall - 3.5), 0, sonar_height]) children();
}

module body() {
    difference() {
        linear_extrude(height) outline();
        difference() {
            translate([0, 0, wall]) linear_extrude(height - 2 * wall) intersection() {
                offset(delta = -wall) outline();
                translate([-500, 0]) square([1000, 1000]);
            }
            if (has_bank) translate([-500, -1, wall + bay_height]) cube([1000, 1000, wall]);
        }
        // Open towards the wall: the plate closes it.
        translate([-half_width + wall, -1, wall]) cube([2 * (half_width - wall), 1 + wall + gap, height - 2 * wall]);
        for (side = [-1, 1]) { can_holes(side); vents(side); }
        // The plug of the supply comes from below, or through the floor of the electronics from the power bank.
        translate([-cable[0] / 2, 7, -1]) cube([cable[0], cable[1], has_bank ? 0 : wall + 2]);
        if (has_bank) translate([-cable[0] / 2, 7, wall + bay_height - 1]) cube([cable[0], cable[1], wall + 2]);
    }
    for (side = [-1, 1]) posts(side);
    screw_places() difference() {
        translate([-3.5, wall + gap, -5]) cube([7, 8, 10]);
        rotate([-90, 0, 0]) cylinder(d = 2.5, h = 20);
    }
}

// A slot into which the head of a wall screw (4 mm, head up to 8 mm) is pushed upwards.
module keyhole() {
    rotate([-90, 0, 0]) { cylinder(d = 9, h = 3 * wall, center = true); }
    translate([0, 0, 5]) cube([4.6, 3 * wall, 10], center = true);
}

module plate() {
    width = 2 * (half_width - wall - gap);
    difference() {
        union() {
            translate([-width / 2, 0, wall + gap]) cube([width, wall, height - 2 * (wall + gap)]);
            // Two rails hold the D1 mini upright at the plate, its plug downwards.
            for (side = [-1, 1]) translate([side * (mcu_board[1] / 2 + 1.5) - 1.5, wall, floor_of_electronics + 1])
                difference() {
                    cube([3, 9, electronics_height - 3]);
                    translate([side > 0 ? -1 : 2, 6, -1]) cube([2, mcu_board[2] + 0.4, electronics_height]);
                }
        }
        for (side = [-1, 1]) translate([side * half_width * 0.6, 0, sonar_height]) keyhole();
        screw_places() rotate([-90, 0, 0]) cylinder(d = 3.4, h = 20, center = true);
    }
}

module sonars() {
    for (side = [-1, 1]) at_face(side) {
        color("seagreen") translate([0, -sonar_can[1] + can_proud - sonar_board[2] / 2, 0])
            cube([sonar_board[0], sonar_board[2], sonar_board[1]], center = true);
        color("silver") for (x = [-1, 1]) translate([x * sonar_cans_apart / 2, can_proud, 0])
            rotate([90, 0, 0]) cylinder(d = 16, h = sonar_can[1]);
    }
}

if (part == "body") rotate([180, 0, 0]) body();
else if (part == "plate") rotate([90, 0, 0]) plate();
else if (part == "shown_body") body();          // as it hangs on the wall, for the picture
else if (part == "shown_plate") plate();
else { body(); plate(); sonars(); }
